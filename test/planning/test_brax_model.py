"""The Brax system is the arm of the table, and loading it says nothing."""

import brax
import numpy as np
import pytest

from contact_reach_ros.planning.transfer.model import ArmModel, arm_model, load_system
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import rotation_from_quaternion, tensor_matrix


@pytest.fixture(scope="module")
def system() -> brax.System:
    return load_system()


@pytest.fixture(scope="module")
def arm(system) -> ArmModel:
    return arm_model(system)


def test_loading_is_silent(capfd, recwarn):
    load_system()
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert not recwarn.list


def test_system_is_a_brax_system_of_seven_hinges(system):
    assert isinstance(system, brax.System)
    assert system.link_types == "1" * iiwa14.N_JOINTS
    assert tuple(system.link_names) == iiwa14.LINK_NAMES
    np.testing.assert_array_equal(system.dof.motion.ang, np.tile([0.0, 0.0, 1.0], (7, 1)))


def test_kinematics_are_those_of_the_table(arm):
    for index, joint in enumerate(iiwa14.JOINTS):
        np.testing.assert_allclose(arm.joint_offset[index], joint.offset, rtol=0, atol=1e-7)
        rotation = rotation_from_quaternion(joint.rotation)
        np.testing.assert_allclose(arm.joint_rotation[index], rotation, rtol=0, atol=1e-7)
    np.testing.assert_allclose(arm.position_limit, iiwa14.POSITION_LIMITS, rtol=1e-6)


def test_inertial_parameters_are_those_of_the_table(arm):
    for index, inertia in enumerate(iiwa14.NOMINAL_INERTIAS):
        assert arm.mass[index] == pytest.approx(inertia.mass, rel=1e-6)
        np.testing.assert_allclose(arm.center_of_mass[index], inertia.center, rtol=0, atol=1e-7)
        np.testing.assert_allclose(arm.inertia[index], tensor_matrix(inertia.tensor), rtol=0, atol=1e-7)
    np.testing.assert_allclose(arm.armature, iiwa14.ARMATURE, rtol=1e-6)


def test_capsules_belong_to_the_last_links_in_order(arm):
    """The contact arithmetic relies on it."""
    np.testing.assert_array_equal(arm.capsule_link, np.arange(1, 7))
