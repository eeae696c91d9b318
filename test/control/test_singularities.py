"""Near singularities Λ stays bounded and torques stay continuous."""

import numpy as np
import pytest
from arm_simulation import ARM
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.law import ImpedanceLaw, pose_error
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.kernels import solve_bounded
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import SINGULARITY_FLOOR, ImpedanceSettings

SINGULAR = {
    "stretched upwards": np.zeros(ARM.n),
    "stretched forwards": np.array([0.0, np.pi / 4, 0.0, 0.0, 0.0, np.pi / 4, 0.0]),
    "shoulder": np.array([0.3, 0.0, np.pi / 2, -1.2, 0.4, 0.8, 0.1]),
    "wrist": np.array([0.3, 0.6, 0.2, -1.2, np.pi / 2, 0.0, 0.1]),
    "shoulder and wrist": np.array([0.3, 0.0, 0.2, -1.2, 0.4, 0.0, 0.1]),
}


def orthogonal(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((6, 6)))[0]


def bounded_inverse(matrix: np.ndarray, floor: float) -> np.ndarray:
    """What `solve_bounded` multiplies by, column by column."""
    return np.array([solve_bounded(matrix, unit, floor) for unit in np.eye(len(matrix))]).T


eigenvalues = st.lists(st.floats(0.0, 5.0), min_size=6, max_size=6).map(np.array)
seeds = st.integers(0, 1000)


@given(eigenvalues, seeds)
def test_the_inverse_is_bounded_and_never_asks_for_more_than_the_true_one(values, seed):
    vectors = orthogonal(seed)
    matrix = (vectors * values) @ vectors.T
    inverse = bounded_inverse(matrix, SINGULARITY_FLOOR)
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-9)
    assert np.linalg.norm(inverse, 2) <= 2.0 / SINGULARITY_FLOOR * (1 + 1e-9)
    # Λ_bounded (J M⁻¹ Jᵀ) has eigenvalues in [0, 1]: an acceleration may fall short, never overshoot.
    share = np.linalg.eigvals(inverse @ matrix)
    np.testing.assert_allclose(share.imag, 0, atol=1e-9)
    assert share.real.min() >= -1e-9 and share.real.max() <= 1 + 1e-9
    above = (vectors * (values + SINGULARITY_FLOOR)) @ vectors.T
    np.testing.assert_allclose(bounded_inverse(above, SINGULARITY_FLOOR) @ above, np.eye(6), rtol=0, atol=1e-10)


def torque_at(model: RobotModel, law: ImpedanceLaw, q: np.ndarray, v: np.ndarray, reference: Reference) -> np.ndarray:
    model.update(q, v)
    return law.torque(model, v, q - reference.posture, pose_error(model.position, model.rotation, reference))


@pytest.fixture(params=SINGULAR)
def singular(request) -> np.ndarray:
    return SINGULAR[request.param]


def pulled_reference(model: RobotModel, q: np.ndarray) -> Reference:
    """1 cm and some posture away from the pose at `q`."""
    position, rotation = model.tip_pose(q)
    return Reference(position + np.array([0.006, 0.005, -0.006]), rotation, q + 0.2)


def test_torques_change_smoothly_along_a_path_through_a_singularity(singular):
    model, law, random = RobotModel(ARM), ImpedanceLaw(ARM, ImpedanceSettings()), np.random.default_rng(1)
    direction, v = random.standard_normal(ARM.n), 0.1 * random.standard_normal(ARM.n)
    direction /= np.linalg.norm(direction)
    reference = pulled_reference(model, singular)

    def largest_change(count: int) -> float:
        path = [singular + share * direction for share in np.linspace(-0.05, 0.05, count + 1)]
        torques = np.array([torque_at(model, law, q, v, reference) for q in path])
        return float(np.abs(np.diff(torques, axis=0)).max())

    # A jump would stay as large; what is continuous changes half as much over half the distance.
    coarse, fine = largest_change(200), largest_change(400)
    assert fine == pytest.approx(0.5 * coarse, rel=0.1)
