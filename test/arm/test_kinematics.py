"""The two descriptions of the arm, and the inertial parameters moved from one into the other."""

import numpy as np
import pytest
from arm_simulation import ARM, random_states
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.arm.kinematics import (
    link_frames,
    rotation_from_quaternion,
    tensor_matrix,
)
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.arms.iiwa14 import aligned_link_frames
from contact_reach_ros.errors import SettingsError

GRAVITY = 9.81
STEP = 1e-6

components = st.floats(-1, 1)
quaternions = st.tuples(components, components, components, components).filter(lambda x: np.linalg.norm(x) > 1e-3)


@given(quaternions)
def test_quaternions_give_rotations(quaternion):
    rotation = rotation_from_quaternion(quaternion)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-12)
    assert np.linalg.det(rotation) > 0
    np.testing.assert_allclose(rotation, rotation_from_quaternion(-3.0 * np.array(quaternion)), rtol=0, atol=1e-12)


def test_both_descriptions_have_the_same_flange():
    for q in random_states(200)[0]:
        rotations, origins = link_frames(ARM, q)
        aligned_rotations, aligned_origins = aligned_link_frames(q)
        np.testing.assert_allclose(origins[-1], aligned_origins[-1], rtol=0, atol=1e-14)
        np.testing.assert_allclose(rotations[-1], aligned_rotations[-1], rtol=0, atol=1e-14)


def aligned_energies(q: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """Kinetic (armature excluded) and potential energy from the second description alone, by finite differences."""
    kinetic, potential = 0.0, 0.0
    frames = zip(*aligned_link_frames(q), *aligned_link_frames(q + STEP * v), iiwa14.ALIGNED_INERTIAS, strict=False)
    for rotation, origin, next_rotation, next_origin, inertia in frames:
        center = origin + rotation @ inertia.center
        velocity = (next_origin + next_rotation @ inertia.center - center) / STEP
        cross = (next_rotation - rotation) @ rotation.T / STEP
        spin = 0.5 * np.array([cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]])
        tensor = rotation @ tensor_matrix(inertia.tensor) @ rotation.T
        kinetic += 0.5 * inertia.mass * velocity @ velocity + 0.5 * spin @ tensor @ spin
        potential += inertia.mass * GRAVITY * center[2]
    return kinetic, potential


def test_converted_inertias_keep_kinetic_and_potential_energy():
    model = RobotModel(ARM, "alternative")
    for q, v in zip(*random_states(50), strict=True):
        model.update(q, v)
        kinetic, _ = aligned_energies(q, v)
        armature = 0.5 * ARM.joints[0].armature * v @ v
        assert 0.5 * v @ model.mass_matrix @ v - armature == pytest.approx(kinetic, rel=1e-4)
        for joint, direction in enumerate(np.eye(ARM.n)):
            ahead = aligned_energies(q + 1e-4 * direction, v)[1]
            behind = aligned_energies(q - 1e-4 * direction, v)[1]
            assert model.gravity[joint] == pytest.approx((ahead - behind) / 2e-4, abs=1e-5)


@pytest.mark.parametrize("inertia_set", tuple(ARM.inertia_sets))
def test_inertias_are_possible(inertia_set):
    for inertia in ARM.inertias(inertia_set):
        principal = np.linalg.eigvalsh(tensor_matrix(inertia.tensor))
        assert inertia.mass > 0
        assert principal[0] > 0
        assert principal[2] <= principal[0] + principal[1]


def test_joints_are_found_by_name():
    assert [ARM.joint_index(name) for name in ARM.joint_names] == list(range(ARM.n))
    with pytest.raises(SettingsError, match=r"'lbr_A8'.*lbr_A1, .*lbr_A7"):
        ARM.joint_index("lbr_A8")
