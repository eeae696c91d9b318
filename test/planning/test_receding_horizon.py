"""A planner that plans again and again."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, ideal_plant
from planning_helpers import PERMITTED_FORCE, SMALL, make_planner

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.law import ImpedanceLaw, pose_error
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.prediction import hold_at, reference_at
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.simulation.plant import Actuation
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

MS = 1_000_000
ROTATIONS, ORIGINS = link_frames(ARM, HOME)
FLANGE = ORIGINS[-1]
GOAL = Target(FLANGE + np.array([0.1, 0.15, -0.1]))


def ball_at(center: np.ndarray) -> Spheres:
    return Spheres(center[None], center[None], np.array([0.1]), np.array([100.0]), np.array([30.0]))


def plan_from(planner, q=HOME, v=REST, state=0, effect=0, goal=GOAL, spheres=None) -> Plan:
    """Times in ms."""
    return planner.plan(Request(q, v, state * MS, effect * MS, goal, Spheres.none() if spheres is None else spheres))


def test_plan_moves_towards_the_goal_within_the_bounds(planner):
    plan = plan_from(planner)
    settings = planner._settings
    distances = np.linalg.norm(plan.predicted_positions - GOAL.position, axis=1)
    assert (np.diff(distances) < 0.0).all()
    np.testing.assert_allclose(plan.predicted_q[0], HOME, rtol=0, atol=1e-6)
    moves = np.abs(plan.positions - plan.predicted_positions[:-1])
    assert moves[0].max() <= settings.translation_bound + 1e-6
    # From where the moving arm is half a ramp later.
    gains = ImpedanceSettings()
    ahead = 0.5 * gains.reference_ramp * gains.task_stiffness / gains.task_damping
    assert settings.translation_bound < moves[1:].max() <= (1.0 + ahead) * settings.translation_bound
    assert np.abs(plan.postures - plan.predicted_q[:-1]).max() <= settings.posture_bound + 1e-6
    np.testing.assert_allclose(
        plan.rotations @ plan.rotations.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-5
    )


def test_cost_terms_add_up(planner):
    plan = plan_from(planner)
    assert plan.cost == pytest.approx(sum(plan.cost_terms.values()))


def test_arm_reaches_a_free_goal(planner):
    """Every 100 ms a plan, no latency, law (3) on the simulated arm."""
    plant, model, law = ideal_plant(), RobotModel(ARM), ImpedanceLaw(ARM, ImpedanceSettings())
    plant.set_actuation(Actuation.COMMANDED)
    plans: list[Plan] = []
    for tick in range(4000):
        q, v = plant.data.qpos[:7].copy(), plant.data.qvel[:7].copy()
        if tick % 100 == 0:
            plans.append(plan_from(planner, q, v, tick, tick))
        model.update(q, v)
        if np.linalg.norm(model.position - GOAL.position) < 0.01:
            break
        reference = Reference(*reference_at(plans, (tick + 1) * MS))
        error = pose_error(model.position, model.rotation, reference)
        plant.step(law.torque(model, v, q - reference.posture, error) + model.bias)
    else:
        pytest.fail(f"still {np.linalg.norm(model.position - GOAL.position):.3f} m away after 4 s")
    # The bounds and gains let no axis move faster than 0.088 m/s.
    assert 0.15 / 0.088 < tick / 1000 < 2 * 0.15 / 0.088


@pytest.mark.slow
def test_law_6_pulls_to_one_posture_and_leaves_the_rest_to_the_task():
    posture = (0.1, 0.2, 0.3, -0.4, 0.5, 0.6, 0.7)
    planner = make_planner(null_space="reference_posture", reference_posture=posture)
    plan = plan_from(planner)
    np.testing.assert_allclose(plan.postures, np.tile(posture, (3, 1)), rtol=0, atol=1e-6)
    assert plan.cost_terms["null_motion"] == 0.0
    distances = np.linalg.norm(plan.predicted_positions - GOAL.position, axis=1)
    assert (np.diff(distances) < 0.0).all()
    # What the planner expects is what law (2) with this q_d does to the arm.
    plant, model, law = ideal_plant(), RobotModel(ARM), ImpedanceLaw(ARM, ImpedanceSettings())
    plant.set_actuation(Actuation.COMMANDED)
    for tick in range(100):
        model.update(plant.data.qpos[:7].copy(), plant.data.qvel[:7].copy())
        reference = Reference(*reference_at([plan], (tick + 1) * MS))
        error = pose_error(model.position, model.rotation, reference)
        difference = plant.data.qpos[:7] - reference.posture
        plant.step(law.torque(model, plant.data.qvel[:7].copy(), difference, error) + model.bias)
    np.testing.assert_allclose(plant.data.qpos[:7], plan.predicted_q[1], rtol=0, atol=0.01)
    assert np.abs(plan.predicted_q[1] - plan.predicted_q[0]).max() > 0.05


def test_ball_in_the_way_is_pushed_with_less_than_the_permitted_force(planner):
    elbow = ORIGINS[4] + ROTATIONS[4] @ (0.0, 0.0, 0.11) + np.array([0.0, 0.185, 0.0])
    q, v, spheres = HOME, REST, ball_at(elbow)
    goal = Target(FLANGE + np.array([0.0, 0.25, 0.0]))
    for number in range(10):
        plan = plan_from(planner, q, v, 100 * number, 100 * number, goal, spheres)
        assert plan.predicted_contact_forces.max() <= PERMITTED_FORCE + 0.5
        q, v = plan.predicted_q[1], (plan.predicted_q[2] - plan.predicted_q[1]) / 0.1
    assert np.linalg.norm(plan.predicted_positions[1] - goal.position) < 0.2


def test_same_calls_after_a_reset_give_the_same_plans_bit_for_bit(planner):
    def sequence() -> list[Plan]:
        planner.reset()
        first = plan_from(planner)
        return [first, plan_from(planner, first.predicted_q[1], REST, 100, 140)]

    for a, b in zip(sequence(), sequence(), strict=True):
        for name in ("positions", "rotations", "postures", "predicted_q", "predicted_contact_forces"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert a.cost_terms == b.cost_terms
        assert (a.steps, a.stop_reason) == (b.steps, b.stop_reason)
        assert a.number < b.number


def test_a_seed_decides_the_candidates_and_begins_afresh(planner):
    plans = []
    for seed in (7, 8, 7):
        planner.reseed(seed)
        plans.append(plan_from(planner))
    planner.reseed(0)
    np.testing.assert_array_equal(plans[0].postures, plans[2].postures)
    assert not np.array_equal(plans[0].postures, plans[1].postures)
    np.testing.assert_allclose(plans[0].positions, plans[1].positions, atol=2e-3)


def test_plan_starts_from_the_state_predicted_under_the_plan_in_force(planner):
    first = plan_from(planner)
    second = plan_from(planner, HOME, REST, 0, 100)
    # The prediction has a step more than the plan's first knot: it is cut where the reference ceases to move.
    np.testing.assert_allclose(second.predicted_q[0], first.predicted_q[1], rtol=0, atol=1e-4)
    planner.reset()
    third = plan_from(planner, HOME, REST, 0, 100)
    np.testing.assert_allclose(third.predicted_q[0], HOME, rtol=0, atol=1e-5)


def test_plan_is_never_worse_than_the_last_one(planner):
    costs = [plan_from(planner, HOME, REST, 0, 100).cost for _ in range(4)]
    assert (np.diff(costs) <= 1e-6).all()


def test_new_goal_is_searched_for_afresh(planner):
    plan_from(planner)
    away = Target(FLANGE - np.array([0.1, 0.15, -0.1]))
    plan = plan_from(planner, HOME, REST, 50, 50, away)
    distances = np.linalg.norm(plan.predicted_positions - away.position, axis=1)
    assert distances[-1] < distances[0] - 0.01


def test_orientation_of_the_goal_is_held(planner):
    plan = plan_from(planner, goal=Target(GOAL.position, ROTATIONS[-1]))
    turned = plan.rotations @ ROTATIONS[-1].T
    angles = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angles.max() < np.radians(6)
    assert plan.cost_terms["orientation"] < 0.02


def test_jump_of_the_arm_and_time_running_backwards_forget_the_plans(planner):
    plan_from(planner, state=1000, effect=1000)
    elsewhere = HOME + 0.5
    plan = plan_from(planner, elsewhere, REST, 1100, 1200)
    # Held where it is, not dragged along by the plan made for another pose.
    np.testing.assert_allclose(plan.predicted_q[0], elsewhere, rtol=0, atol=1e-4)
    plan = plan_from(planner, elsewhere, REST, 0, 100)
    np.testing.assert_allclose(plan.predicted_q[0], elsewhere, rtol=0, atol=1e-4)


@pytest.mark.parametrize("effect", [0, 85], ids=["in force", "not yet"])
def test_a_plan_whose_x_d_is_too_far_to_be_followed_is_expected_to_be_dropped(planner, effect):
    gone = HOME + np.eye(7)[0] * 0.13
    plan = plan_from(planner, state=0, effect=effect)
    distance = np.linalg.norm(plan.positions[0] - hold_at(ARM, gone).position)
    assert 0.055 < distance < 0.1
    dropped = plan_from(planner, gone, REST, 80, 120)
    np.testing.assert_allclose(dropped.predicted_q[0], gone, rtol=0, atol=1e-6)
    np.testing.assert_allclose(dropped.before.position, hold_at(ARM, gone).position, rtol=0, atol=1e-6)
    planner.reset()
    # The arm may be on its way to it.
    near = HOME + np.eye(7)[0] * 0.06
    plan = plan_from(planner, state=0, effect=effect)
    assert 0.02 < np.linalg.norm(plan.positions[0] - hold_at(ARM, near).position) < 0.05
    followed = plan_from(planner, near, REST, 80, 120)
    assert np.abs(followed.predicted_q[0] - near).max() > 1e-4
    np.testing.assert_allclose(followed.before.position, plan.in_force(120 * MS).position, rtol=0, atol=1e-6)


def test_a_controller_that_follows_from_farther_away_is_expected_to_follow(planner):
    """As above, with another setting of the controller."""
    gone = HOME + np.eye(7)[0] * 0.13
    patient = RecedingHorizonPlanner(ARM, SMALL, ImpedanceSettings(), PERMITTED_FORCE, 1, max_position_error=0.2)
    for each in (planner, patient):
        plan_from(each, state=0, effect=0)
    dropped, followed = (plan_from(each, gone, REST, 80, 120) for each in (planner, patient))
    np.testing.assert_allclose(dropped.predicted_q[0], gone, rtol=0, atol=1e-6)
    assert np.abs(followed.predicted_q[0] - gone).max() > 1e-4


def test_spheres_beyond_the_capacity_are_counted(planner):
    centers = np.array([[0.5, 0.4, 0.3], [0.9, 0.0, 1.0]])
    ones = np.ones(2)
    plan = plan_from(planner, spheres=Spheres(centers, centers, 0.05 * ones, 100 * ones, 30 * ones))
    assert plan.left_out == 1


def test_deadline_too_short_for_one_step_is_refused_and_ends_a_search_after_one():
    hurried = make_planner(deadline=1e-6)
    with pytest.raises(SettingsError, match=r"planning.deadline = 1e-06 s: one solver step takes \d+\.\d+ s here"):
        hurried.warm_up(lambda line: None)
    plan = plan_from(hurried)
    assert (plan.stop_reason, plan.steps) == ("deadline", 1)
    assert np.isfinite(plan.cost)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q": np.zeros(6)}, "q = .*expected 7 finite numbers"),
        ({"v": np.full(7, np.nan)}, "v = .*expected 7 finite numbers"),
        ({"state": 10, "effect": 9}, "effect_ns - state_ns = -1000000: expected 0 to"),
        ({"state": 0, "effect": 5000}, "plan from a newer state"),
    ],
)
def test_input_that_makes_no_sense_is_refused(planner, arguments, message):
    with pytest.raises(InputError, match=message):
        plan_from(planner, **arguments)


def test_warm_up_tells_what_it_does(warm_planner):
    lines: list[str] = []
    warm_planner.warm_up(lines.append)
    assert lines[0].startswith("planner: preparing the programs")
    assert "ready" in lines[-1] and "one solver step takes" in lines[-1]
