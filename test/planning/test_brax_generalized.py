"""Brax's own pipeline as the transfer function."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import SMALL, make_problem, obstacles_of

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.law import ImpedanceLaw, pose_error
from contact_reach_ros.control.references import Reference as LawReference
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.node_settings import ReplanningSettings
from contact_reach_ros.planning.objectives import knot_bounds, make_objective
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.brax_generalized import BraxObjective, law_torque, network
from contact_reach_ros.planning.transfer.closed_loop import Reference
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.stack import Stack, make_planner
from contact_reach_ros.world.goal import Goal
from contact_reach_ros.world.spheres import Spheres


def objective(pipeline: str) -> Objective:
    return make_objective(ARM, dataclasses.replace(SMALL, pipeline=pipeline), ImpedanceSettings())


def test_setting_chooses_the_pipeline():
    assert not isinstance(objective("closed_loop"), BraxObjective)
    assert isinstance(objective("generalized"), BraxObjective)


def test_it_moves_the_arm_as_the_closed_loop_does():
    """In free space and from motion, within a tenth of the way that the tip goes."""
    random = np.random.default_rng(1)
    bounds = knot_bounds(ARM, SMALL)
    # Always ahead, so that the arm goes somewhere; turns and elbow at random.
    share = random.uniform(-1.0, 1.0, (SMALL.horizon, len(bounds), 4)).astype(np.float32)
    share[:, :3] = np.array([[1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, 1.0], [1.0, 1.0, -1.0, 1.0]])
    problem = make_problem(HOME, HOME[:3], None)._replace(v=jnp.asarray(random.uniform(-0.2, 0.2, (7, 1))))
    actions = share * bounds[None, :, None]
    rollouts = [
        # To compile takes nearly all of the time.
        jax.jit(objective(name).roll_out, compiler_options={"xla_backend_optimization_level": 0})(problem, actions)
        for name in ("closed_loop", "generalized")
    ]
    ours, theirs = (np.asarray(rollout.pose.position) for rollout in rollouts)
    way = np.linalg.norm(np.diff(ours, axis=0), axis=1).sum(axis=0)
    assert way.min() > 0.02
    assert np.all(np.linalg.norm(theirs - ours, axis=1) < 0.1 * way), np.linalg.norm(theirs - ours, axis=1)
    assert np.abs(np.asarray(rollouts[1].q - rollouts[0].q)).max() < np.radians(2.0)


@pytest.mark.parametrize(
    "setting, message",
    [
        ({"pipeline": "mjx"}, "pipeline = 'mjx': expected one of closed_loop, generalized"),
        ({"device": "tpu"}, "device = 'tpu': expected .*auto.*cpu.*gpu"),
    ],
)
def test_pipelines_and_devices_that_are_not_there_are_refused(setting, message):
    with pytest.raises(SettingsError, match=message):
        PlanningSettings(**setting)


def test_torque_is_that_of_the_controller():
    """With the arm in motion and away from its references."""
    random = np.random.default_rng(1)
    q, v = HOME + random.uniform(-0.3, 0.3, 7), random.uniform(-0.5, 0.5, 7)
    gains, model = ImpedanceSettings(), RobotModel(ARM)
    model.update(q, v)
    desired = LawReference(model.position + 0.01, pin.exp3(np.array([0.1, -0.05, 0.1])) @ model.rotation, q + 0.1)
    error = pose_error(model.position, model.rotation, desired)
    expected = ImpedanceLaw(ARM, gains).torque(model, v, q - desired.posture, error)
    reference = Reference(
        *(jnp.asarray(part)[..., None] for part in (desired.position, desired.rotation, desired.posture))
    )
    torque = jax.jit(lambda q, v: law_torque(arm_model(ARM), gains, q, v, reference))(q[:, None], v[:, None])
    np.testing.assert_allclose(torque[:, 0], expected, rtol=1e-3, atol=1e-2)


def test_network_of_the_spheres_is_recovered():
    centers = np.array([[0.5, 0.3, 0.5], [0.5, 0.4, 0.5], [0.5, 0.5, 0.5]])
    spheres = Spheres(
        centers,
        centers,
        np.full(3, 0.03),
        np.array([100.0, 50.0, 80.0]),
        np.array([5.0, 6.0, 7.0]),
        np.array([[0, 1], [1, 2]]),
        np.array([60.0, 40.0]),
    )
    stiffness, damping = network(obstacles_of(spheres))
    expected = [[160.0, -60.0, 0.0], [-60.0, 150.0, -40.0], [0.0, -40.0, 120.0]]
    np.testing.assert_allclose(stiffness, expected, rtol=1e-4, atol=0.02)
    np.testing.assert_allclose(damping, np.diag([5.0, 6.0, 7.0]), rtol=1e-4, atol=1e-3)


@pytest.mark.slow
def test_generalized_pipeline_makes_whole_plans_that_lead_around_the_ball():
    """In lockstep, with a small budget: ten plans a second of three solver steps with 32 candidates each."""
    planning = dataclasses.replace(
        PlanningSettings(deadline=0.0),
        pipeline="generalized",
        population=32,
        elite=8,
        line_search_points=32,
        max_steps=3,
    )
    scene = load_scene("ball", arm=ARM, seed=0)
    planner = make_planner(ARM, 1, planning=planning, replanning=ReplanningSettings(period=0.1))
    result = Stack(scene, planner=planner).run(Goal(scene.target), timeout=8.0)
    assert result.reached, result
    assert result.max_contact_force < load_budget().permitted_force
    assert result.plans > 30
