"""Kinematics, mass matrix and drift of the transfer model against Pinocchio, which reads the same MJCF."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, random_states

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.planning.transfer.dynamics import arm_dynamics
from contact_reach_ros.planning.transfer.kinematics import flange_drift, link_frames
from contact_reach_ros.planning.transfer.lanes import make_keep
from contact_reach_ros.planning.transfer.model import arm_model

COUNT = 40


@pytest.fixture(scope="module")
def computed() -> tuple[np.ndarray, ...]:
    """Flange positions, rotations, Jacobians, mass matrices and drifts of random states, lanes last."""

    @jax.jit
    def run(q: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
        keep = make_keep(q)
        frames = link_frames(arm_model(ARM), q, keep)
        dynamics = arm_dynamics(arm_model(ARM), frames, keep)
        drift = flange_drift(frames, v, keep)
        return frames.flange, frames.flange_rotation, dynamics.jacobian, dynamics.mass_matrix, drift

    q, v = random_states(COUNT)
    return tuple(np.asarray(array) for array in run(jnp.asarray(q.T), jnp.asarray(v.T)))


@pytest.fixture(scope="module")
def expected() -> list[dict[str, np.ndarray]]:
    model = RobotModel(ARM)
    states = []
    for q, v in zip(*random_states(COUNT), strict=True):
        model.update(q, v)
        names = ("position", "rotation", "jacobian", "mass_matrix", "drift")
        states.append({name: getattr(model, name).copy() for name in names})
    return states


@pytest.mark.parametrize(
    ("index", "name", "tolerance"),
    [(0, "position", 1e-6), (1, "rotation", 2e-6), (2, "jacobian", 2e-6), (4, "drift", 1e-4)],
)
def test_quantity_agrees_with_pinocchio(computed, expected, index, name, tolerance):
    reference = np.stack([state[name] for state in expected], axis=-1)
    np.testing.assert_allclose(computed[index], reference, rtol=1e-5, atol=tolerance)


def test_upper_triangle_of_mass_matrix_agrees_with_pinocchio(computed, expected):
    reference = np.stack([state["mass_matrix"] for state in expected], axis=-1)
    rows, columns = np.triu_indices(7)
    np.testing.assert_allclose(computed[3][rows, columns], reference[rows, columns], rtol=1e-5, atol=1e-5)
