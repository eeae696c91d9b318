"""The Brax system is the one source of the transfer model, and loading it says nothing."""

import dataclasses

import brax
import numpy as np
import pytest
from arm_simulation import ARM
from planning_helpers import PERMITTED_FORCE, SMALL

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.kinematics import link_frames, rotation_from_quaternion, tensor_matrix
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.transfer import model
from contact_reach_ros.planning.transfer.model import ArmModel, arm_model, load_system, read_arm
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

HOME = np.array(ARM.home)


@pytest.fixture(scope="module")
def system() -> brax.System:
    return load_system(build_mjcf(ARM))


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return arm_model(ARM)


def test_loading_is_silent(capfd, recwarn):
    load_system(build_mjcf(ARM))
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
    np.testing.assert_array_equal(arm.velocity_limit, ARM.velocity_limits)
    np.testing.assert_array_equal(arm.flange_offset, ARM.tip_offset)


def test_inertial_parameters_are_those_of_the_table(arm):
    for index, inertia in enumerate(ARM.inertias()):
        assert arm.mass[index] == pytest.approx(inertia.mass, rel=1e-6)
        np.testing.assert_allclose(arm.center_of_mass[index], inertia.center, rtol=0, atol=1e-7)
        np.testing.assert_allclose(arm.inertia[index], tensor_matrix(inertia.tensor), rtol=0, atol=1e-7)
    np.testing.assert_allclose(arm.armature, ARM.joints[0].armature, rtol=1e-6)


def test_capsules_are_those_of_the_table_to_the_last_digit(arm):
    np.testing.assert_array_equal(arm.capsule_start, [capsule.start for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_axis, [np.subtract(each.end, each.start) for each in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_radius, [capsule.radius for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.base_start, ARM.base_capsule.start)
    assert arm.base_radius == ARM.base_capsule.radius
    assert arm.contact_links == ARM.contact_links
    assert arm.self_pairs == self_pairs(ARM)


def test_capsules_are_one_on_each_of_the_last_links(arm):
    """The contact arithmetic is faster where it is so."""
    np.testing.assert_array_equal(arm.capsule_link, np.arange(1, 7))


def longer(arm: Arm) -> Arm:
    """With a forearm that is 0.1 m longer, and its tip elsewhere."""
    joints = list(arm.joints)
    joints[4] = dataclasses.replace(joints[4], offset=(0.0, 0.2845, 0.0))
    return dataclasses.replace(arm, joints=tuple(joints), tip_offset=(0.02, 0.0, 0.1))


def test_planner_plans_for_the_arm_of_the_mjcf(monkeypatch, quick_compilation):
    other = longer(ARM)
    monkeypatch.setattr(model, "build_mjcf", lambda arm: build_mjcf(other))
    arm_model.cache_clear()
    try:
        planner = RecedingHorizonPlanner(ARM, SMALL, ImpedanceSettings(), PERMITTED_FORCE, capacity=0)
    finally:
        arm_model.cache_clear()
    start = link_frames(other, HOME)[1][-1]
    goal = Target(start + np.array([0.0, 0.1, 0.0]))
    plan = planner.plan(Request(HOME, np.zeros(ARM.n), 0, 10_000_000, goal, Spheres.none()))
    for q, position in zip(plan.predicted_q, plan.predicted_positions, strict=True):
        np.testing.assert_allclose(position, link_frames(other, q)[1][-1], rtol=0, atol=1e-5)
        assert np.linalg.norm(position - link_frames(ARM, q)[1][-1]) > 0.05


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="capsule" fromto="0.0 0.0 -0.01', 'type="cylinder" fromto="0.0 0.0 -0.01', "expected one capsule"),
        ('armature="0.01"', 'armature="0.01" damping="1"', "without springs and dampers"),
        ('axis="0 0 1"', 'axis="0 1 0"', "about the z axes"),
        ('name="flange"', 'name="tcp"', "expected 'flange'"),
        ("velocity_limits", "speeds", "expected the custom field velocity_limits"),
        ('name="lbr_A7" axis', 'name="lbr_A7" type="slide" axis', "about the z axes"),
    ],
)
def test_system_that_the_kernel_cannot_handle_is_refused(old, new, message):
    text = build_mjcf(ARM)
    assert old in text
    with pytest.raises(SettingsError, match=message):
        read_arm(load_system(text.replace(old, new)))
