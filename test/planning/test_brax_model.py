"""The Brax system is the arm of the table, and loading it says nothing."""

import brax
import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.arm.kinematics import rotation_from_quaternion, tensor_matrix
from contact_reach_ros.planning.transfer.model import ArmModel, arm_model, load_system


@pytest.fixture(scope="module")
def system() -> brax.System:
    return load_system(ARM)


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return arm_model(ARM)


def test_loading_is_silent(capfd, recwarn):
    load_system(ARM)
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert not recwarn.list


def test_system_is_a_brax_system_of_seven_hinges(system):
    assert isinstance(system, brax.System)
    assert system.link_types == "1" * ARM.n
    assert tuple(system.link_names) == ARM.link_names
    np.testing.assert_array_equal(system.dof.motion.ang, np.tile([0.0, 0.0, 1.0], (7, 1)))


def test_kinematics_are_those_of_the_table(arm):
    for index, joint in enumerate(ARM.joints):
        np.testing.assert_allclose(arm.joint_offset[index], joint.offset, rtol=0, atol=1e-7)
        rotation = rotation_from_quaternion(joint.rotation)
        np.testing.assert_allclose(arm.joint_rotation[index], rotation, rtol=0, atol=1e-7)
    np.testing.assert_allclose(arm.lower, ARM.lower, rtol=1e-6)
    np.testing.assert_allclose(arm.upper, ARM.upper, rtol=1e-6)


def test_inertial_parameters_are_those_of_the_table(arm):
    for index, inertia in enumerate(ARM.inertias()):
        assert arm.mass[index] == pytest.approx(inertia.mass, rel=1e-6)
        np.testing.assert_allclose(arm.center_of_mass[index], inertia.center, rtol=0, atol=1e-7)
        np.testing.assert_allclose(arm.inertia[index], tensor_matrix(inertia.tensor), rtol=0, atol=1e-7)
    np.testing.assert_allclose(arm.armature, ARM.joints[0].armature, rtol=1e-6)


def test_capsules_are_one_on_each_of_the_last_links(arm):
    """The contact arithmetic is faster where it is so."""
    np.testing.assert_array_equal(arm.capsule_link, np.arange(1, 7))
