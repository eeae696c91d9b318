"""Kinematics, mass matrix and drift of the transfer model against Pinocchio, which reads the same MJCF."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME, WITH_TOOL, random_states
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.planning.transfer import model
from contact_reach_ros.planning.transfer.arithmetic import cosine_and_sine
from contact_reach_ros.planning.transfer.dynamics import arm_dynamics, flange_drift, link_frames
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.planning.transfer.pipeline import Reference, pose_error

COUNT = 40
POSITION, TURN = np.array([0.4, 0.1, 0.3]), np.array([0.1, -0.2, 0.15])


def turned(rotation: jax.Array) -> jax.Array:
    """Rotations (3, 3, B) from which those given are turned by `TURN` about the axes of the base."""
    return jnp.einsum("ij,jkb->ikb", Rotation.from_rotvec(-TURN).as_matrix(), rotation)


@pytest.fixture(scope="module", params=[pytest.param(ARM, marks=pytest.mark.slow), WITH_TOOL], ids=["iiwa", "tool"])
def arm(request) -> Arm:
    return request.param


@pytest.fixture(scope="module")
def computed(arm) -> tuple[np.ndarray, ...]:
    """Flange positions, rotations, Jacobians, mass matrices, drifts and pose errors of random states, lanes last."""

    @jax.jit
    def run(q: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
        frames = link_frames(arm_model(arm), q)
        dynamics = arm_dynamics(arm_model(arm), frames)
        drift = flange_drift(frames, v)
        error = pose_error(frames, Reference(jnp.asarray(POSITION)[:, None], turned(frames.flange_rotation), q))
        return frames.flange, frames.flange_rotation, dynamics.jacobian, dynamics.mass_matrix, drift, error

    q, v = random_states(COUNT)
    return tuple(np.asarray(array) for array in run(jnp.asarray(q.T), jnp.asarray(v.T)))


@pytest.fixture(scope="module")
def expected(arm) -> list[dict[str, np.ndarray]]:
    robot = RobotModel(arm)
    states = []
    for q, v in zip(*random_states(COUNT), strict=True):
        robot.update(q, v)
        names = ("position", "rotation", "jacobian", "mass_matrix", "drift")
        states.append({name: getattr(robot, name).copy() for name in names})
        states[-1]["error"] = np.concatenate([robot.position - POSITION, TURN])
    return states


@pytest.mark.parametrize(
    ("index", "name", "tolerance"),
    [(0, "position", 1e-6), (1, "rotation", 2e-6), (2, "jacobian", 2e-6), (4, "drift", 1e-4), (5, "error", 1e-5)],
)
def test_quantity_agrees_with_pinocchio(computed, expected, index, name, tolerance):
    reference = np.stack([state[name] for state in expected], axis=-1)
    np.testing.assert_allclose(computed[index], reference, rtol=1e-5, atol=tolerance)


def test_upper_triangle_of_mass_matrix_agrees_with_pinocchio(computed, expected):
    reference = np.stack([state["mass_matrix"] for state in expected], axis=-1)
    rows, columns = np.triu_indices(7)
    np.testing.assert_allclose(computed[3][rows, columns], reference[rows, columns], rtol=1e-5, atol=1e-5)


def test_cosine_and_sine_with_their_derivatives_over_many_turns():
    angle = np.linspace(-100.0, 100.0, 20001).astype(np.float32)
    found, derivative = jax.jvp(jax.jit(cosine_and_sine), (angle,), (np.ones_like(angle),))
    exact = np.cos(angle.astype(float)), np.sin(angle.astype(float))
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-7)
    np.testing.assert_allclose(derivative, (-exact[1], exact[0]), rtol=0, atol=2e-7)


def test_the_model_is_the_arm_of_the_mjcf(monkeypatch):
    """A forearm that is 0.1 m longer, and a tip that is elsewhere, change the file alone."""
    joints = list(ARM.joints)
    joints[4] = dataclasses.replace(joints[4], offset=(0.0, 0.2845, 0.0))
    other = dataclasses.replace(ARM, joints=tuple(joints), tip_offset=(0.02, 0.0, 0.1))
    monkeypatch.setattr(model, "build_mjcf", lambda arm: build_mjcf(other))
    arm_model.cache_clear()
    try:
        flange = link_frames(arm_model(ARM), HOME[:, None]).flange[:, 0]
    finally:
        arm_model.cache_clear()
    np.testing.assert_allclose(flange, RobotModel(other).tip_pose(HOME)[0], rtol=0, atol=1e-5)
    assert np.linalg.norm(flange - RobotModel(ARM).tip_pose(HOME)[0]) > 0.05
