"""Planning joint torques, and applying them without any control law."""

import dataclasses

import jax
import numpy as np
import pytest
from arm_simulation import HOME, ideal_plant

from contact_reach_ros.baselines.joint_torque import (
    JointTorqueMethod,
    TorquePlan,
    TorquePlanner,
    torque_bounds,
    torque_step,
)
from contact_reach_ros.control.constants import stop_damping
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.planning.objectives import make_objective
from contact_reach_ros.planning.prediction import pieces_between, reference_at
from contact_reach_ros.planning.problem import Goal, HeldTorque, Spheres
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.plant.plant import Actuation
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.scene import Scene

SETTINGS = PlanningSettings(deadline=0.0, population=48, elite=12, line_search_points=32, horizon=2, max_steps=6)
GAINS, CONTROLLER = ImpedanceSettings(), ControllerSettings()
REST = np.zeros(7)
MS = 1_000_000
ROTATIONS, ORIGINS = link_frames(HOME)
GOAL = Goal(ORIGINS[-1] + np.array([0.02, 0.06, -0.03]), ROTATIONS[-1])
LIMITS = np.array(iiwa14.TORQUE_LIMITS)


@pytest.fixture(scope="module")
def warm_planner() -> TorquePlanner:
    planner = TorquePlanner(SETTINGS, GAINS, 10.0, 0, stop_damping(CONTROLLER.supervision))
    planner.warm_up(lambda line: None)
    return planner


@pytest.fixture
def planner(warm_planner) -> TorquePlanner:
    warm_planner.reset()
    return warm_planner


def torque_at(method, q, v, now_ns):
    return method.torque(q, v, now_ns, now_ns)


def plan_from(planner, q=HOME, v=REST, state=0, effect=0) -> TorquePlan:
    return planner.plan(q, v, state * MS, effect * MS, GOAL, Spheres.none())


def test_torques_are_within_the_bounds_and_one_for_each_step(planner):
    plan = plan_from(planner)
    assert plan.torques.shape == (SETTINGS.horizon * SETTINGS.substeps, 7)
    bounds = torque_bounds(SETTINGS, GAINS, np.array(iiwa14.HOME_POSITION))
    assert (np.abs(plan.torques) <= bounds + 1e-4).all()
    assert (bounds <= LIMITS).all()
    distances = np.linalg.norm(plan.predicted_positions - GOAL.position, axis=1)
    assert distances[-1] < distances[0] - 0.01


def test_each_torque_holds_for_its_part_of_the_plan(planner):
    plan = plan_from(planner, effect=40)
    assert reference_at([plan], 40 * MS) is None
    for index, torque in enumerate(plan.torques):
        for instant in (40 * MS + index * 25 * MS + 1, 40 * MS + (index + 1) * 25 * MS):
            np.testing.assert_array_equal(plan.in_force(instant).torque, torque)
    assert plan.in_force((40 + 200) * MS + 1) is None
    assert plan.changes_ns[0] == plan.effect_ns and plan.changes_ns[-1] == plan.effect_ns + 200 * MS


def test_plan_starts_from_the_state_predicted_under_the_torques_in_force(planner):
    first = plan_from(planner)
    second = plan_from(planner, HOME, REST, 0, 100)
    np.testing.assert_allclose(second.predicted_q[0], first.predicted_q[1], rtol=0, atol=1e-5)
    planner.reset()
    np.testing.assert_allclose(plan_from(planner, HOME, REST, 0, 100).predicted_q[0], HOME, rtol=0, atol=1e-5)


def test_where_the_plan_has_run_out_the_joints_are_damped(planner):
    plan = plan_from(planner)
    hold = HeldTorque(REST, stop_damping(CONTROLLER.supervision))
    pieces = pieces_between([plan], hold, 190 * MS, 240 * MS, 0.025)
    assert [piece.held is hold for piece in pieces] == [False, True, True]
    v = np.array([0.3, -0.2, 0.1, 0.2, 0.5, -0.5, 0.8])
    system = planner._objective.system
    state = pipeline.init(system, single(HOME[:, None]), single(v[:, None]))
    damped = torque_step(system, state, jax.tree.map(lambda values: single(values[:, None]), hold))
    speeds = np.asarray(damped.qd)[:, 0]
    model = RobotModel()
    model.update(HOME, v)
    assert speeds @ model.mass_matrix @ speeds < v @ model.mass_matrix @ v
    assert np.abs(speeds).max() < np.abs(v).max()


def test_step_is_the_arms_motion_under_gravity_compensation_and_the_torque():
    plant = ideal_plant()
    plant.set_actuation(Actuation.COMMANDED)
    torque = np.array([4.0, -6.0, 3.0, 5.0, 0.4, -0.3, 0.2])
    system = make_objective(PlanningSettings(), GAINS).system
    state = pipeline.init(system, single(HOME[:, None]), single(REST[:, None]))
    for _ in range(4):
        state = torque_step(system, state, HeldTorque(single(torque[:, None]), None))
    model = RobotModel()
    for _ in range(100):
        reading = plant.read()
        model.update(reading.position, reading.velocity)
        plant.step(model.bias + torque)
    moved = plant.read().position - HOME
    assert np.abs(moved).max() > 0.01
    np.testing.assert_allclose(np.asarray(state.q)[:, 0] - HOME, moved, rtol=0.03, atol=1e-3)


def test_standing_still_stops_a_moving_arm(planner):
    v = np.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.2, 0.3])
    problem = planner._problem(single(HOME[:, None]), single(v[:, None]), None, GOAL)
    still = planner._still(problem)
    rollout, _ = planner._evaluate(problem, planner._points(still))
    q = np.asarray(rollout.q)[..., 0]
    coasting = np.asarray(planner._evaluate(problem, planner._points(np.zeros_like(still)))[0].q)[..., 0]
    assert np.abs(q[-1] - q[1]).max() < 0.2 * np.abs(coasting[-1] - coasting[1]).max()


class TestMethod:
    @pytest.fixture
    def method(self, planner) -> JointTorqueMethod:
        method = JointTorqueMethod(planner, CONTROLLER)
        method.start(HOME, REST, 0)
        return method

    def test_planned_torque_and_bias_once_the_plan_is_in_force_and_damping_after_it(self, method):
        model = RobotModel()
        v = np.full(7, 0.05)
        model.update(HOME, v)
        held = torque_at(method, HOME, REST, 0)
        plan = method.plan(HOME, REST, 0, 10 * MS, GOAL, Spheres.none())
        np.testing.assert_allclose(torque_at(method, HOME, REST, 9 * MS), held, rtol=0, atol=0.5)
        np.testing.assert_allclose(torque_at(method, HOME, v, 10 * MS), model.bias + plan.torques[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(torque_at(method, HOME, v, 35 * MS), model.bias + plan.torques[1], rtol=0, atol=1e-9)
        damped = model.bias - stop_damping(CONTROLLER.supervision) * v
        np.testing.assert_allclose(torque_at(method, HOME, v, 210 * MS), damped, rtol=0, atol=1e-9)

    def test_torques_are_capped_at_the_data_sheets_limits(self, method):
        plan = method.plan(HOME, REST, 0, 0, GOAL, Spheres.none())
        method._plans = [dataclasses.replace(plan, torques=np.full_like(plan.torques, 1e4))]
        np.testing.assert_array_equal(torque_at(method, HOME, REST, MS), LIMITS)

    def test_observer_stops_the_arm(self, method):
        method.plan(HOME, REST, 0, 0, GOAL, Spheres.none())
        method.observer_report("lbr_A4: too much", MS)
        assert method.stop_reason == "lbr_A4: too much"
        v = np.full(7, 0.05)
        for tick in range(2, 400):
            torque = torque_at(method, HOME, v, tick * MS)
        model = RobotModel()
        model.update(HOME, v)
        np.testing.assert_allclose(torque, model.bias - stop_damping(CONTROLLER.supervision) * v, rtol=0, atol=1e-6)
        method.start(HOME, REST, 0)
        assert method.stop_reason == ""


def test_an_episode_gets_nearer_to_its_goal(planner):
    scene = Scene("free", 0, HOME, GOAL.position)
    method = JointTorqueMethod(planner, CONTROLLER)
    result = run_episode(scene, method, EpisodeOptions(settle=0.6, timeout=1.0))
    assert not result.stop_reason and not result.failure
    assert result.distances.min() < 0.5 * result.distances[0]
