"""Contact of the transfer model: directions, energy and equilibrium."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import HOME
from planning_helpers import FAR_BALL, LANES, ball, make_objective, make_problem

from contact_reach_ros.planning.obstacles import clearances
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.contact import Contact, Obstacles, contact_forces
from contact_reach_ros.planning.transfer.kinematics import link_frames
from contact_reach_ros.planning.transfer.lanes import make_keep
from contact_reach_ros.planning.transfer.model import default_arm
from contact_reach_ros.robot.kinematics import link_frames as table_frames

STIFFNESS = 1000.0
FOREARM = 3
"""Place of link 5 among the capsules."""


def beside_forearm(gap: float) -> np.ndarray:
    """Centre of a ball beside the forearm of the arm at home, `gap` m from its surface."""
    rotations, origins = table_frames(HOME)
    middle = origins[4] + rotations[4] @ (0.0, 0.0, 0.11)
    return middle + (0.075 + 0.1 + gap) * np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def touch():
    @jax.jit
    def run(q: jax.Array, obstacles: Obstacles) -> Contact:
        keep = make_keep(q)
        return contact_forces(default_arm(), link_frames(default_arm(), q, keep), obstacles, STIFFNESS, keep)

    return lambda q, obstacles: jax.tree.map(np.asarray, run(jnp.asarray(q)[:, None], obstacles))


def test_nothing_is_felt_before_contact(touch):
    contact = touch(HOME, ball(beside_forearm(0.001)))
    assert contact.link_force.max() == 0.0
    assert np.abs(contact.joint_torque).max() == 0.0
    assert contact.touching.max() == 0.0


def test_force_is_stiffness_times_depth_on_the_touched_link_alone(touch):
    contact = touch(HOME, ball(beside_forearm(-0.005)))
    assert contact.link_force[FOREARM, 0] == pytest.approx(5.0, rel=1e-3)
    assert np.delete(contact.link_force, FOREARM).max() == 0.0
    np.testing.assert_allclose(contact.sphere_force[:, 0, 0], [0.0, 5.0, 0.0], rtol=0, atol=1e-2)


def test_joint_torque_is_the_derivative_of_the_contact_energy(touch):
    center = beside_forearm(-0.01)
    spheres = Spheres(center[None], center[None], np.array([0.1]), np.array([100.0]), np.array([30.0]))

    def energy(q: np.ndarray) -> float:
        return 0.5 * STIFFNESS * min(clearances(q, spheres)[0], 0.0) ** 2

    step = 1e-5
    expected = [-(energy(HOME + step * axis) - energy(HOME - step * axis)) / (2 * step) for axis in np.eye(7)]
    np.testing.assert_allclose(touch(HOME, ball(center)).joint_torque[:, 0], expected, rtol=0, atol=0.01)


@pytest.mark.parametrize(("stiffness", "damping"), [(100.0, 30.0), (5000.0, 1.0)])
def test_ball_that_is_pushed_comes_to_rest_where_its_spring_holds_the_force(stiffness, damping):
    """A stiff anchor with hardly any damping too: no step is too long for the ball."""
    system = make_objective().system
    obstacles = ball(beside_forearm(-0.02), stiffness)._replace(damping=jnp.full((1, 1), damping))

    @jax.jit
    def settle(q: jax.Array) -> pipeline.State:
        state = pipeline.init(system, q, jnp.zeros_like(q), obstacles)
        held = pipeline.latch(state, pipeline.flange_pose(system, state), jnp.zeros((13, 1)))
        return jax.lax.fori_loop(0, 400, lambda _, state: pipeline.step(system, state, held), state)

    state = settle(jnp.asarray(HOME)[:, None])
    assert np.abs(np.asarray(state.qd)).max() < 1e-3
    displacement = np.asarray(state.obstacles.center - state.obstacles.rest)[:, 0, 0]
    force = float(state.link_force.max())
    assert force > 0.5
    assert stiffness * np.linalg.norm(displacement) == pytest.approx(force, rel=0.01)
    assert displacement[1] > 0.0


def test_smaller_time_steps_change_a_push_little(roll_out, objective):
    """The arm pushes into the ball for a whole plan: coarse and fine steps agree on force and motion."""
    problem = make_problem(HOME, np.zeros(3), ball(beside_forearm(-0.01)))
    push = np.zeros((3, 13, 1))
    push[:, 6 + 0] = 0.1
    fine_system = dataclasses.replace(objective.system, timestep=objective.system.timestep / 5)
    fine = dataclasses.replace(objective, system=fine_system, substeps=5 * objective.substeps)
    fine_rollout = jax.jit(fine.roll_out)(problem, push)
    coarse_rollout, _ = roll_out(problem, np.broadcast_to(push, (3, 13, LANES)))
    fine_force, coarse_force = fine_rollout.contact[-1, 0], coarse_rollout.contact[-1, 0]
    assert float(fine_force) > 1.0
    assert float(coarse_force) == pytest.approx(float(fine_force), rel=0.1)
    np.testing.assert_allclose(coarse_rollout.q[-1, :, 0], fine_rollout.q[-1, :, 0], rtol=0, atol=2e-3)


def test_far_away_ball_leaves_the_motion_alone(roll_out):
    problem = make_problem(HOME, np.zeros(3), ball(FAR_BALL))
    rollout, _ = roll_out(problem, np.zeros((3, 13, LANES)))
    assert float(rollout.link_force.max()) == 0.0
    np.testing.assert_allclose(rollout.q[-1, :, 0], HOME, rtol=0, atol=1e-5)
