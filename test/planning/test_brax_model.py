"""The Brax system is the one source of the transfer model, and loading it says nothing."""

import dataclasses

import brax
import numpy as np
import pytest
from arm_simulation import ARM
from planning_helpers import PERMITTED_FORCE, SMALL

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.transfer import model
from contact_reach_ros.planning.transfer.model import ArmModel, arm_model, load_system
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


def test_capsules_are_those_of_the_table_to_the_last_digit(arm):
    np.testing.assert_array_equal(arm.capsule_start, [capsule.start for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_axis, [np.subtract(each.end, each.start) for each in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_radius, [capsule.radius for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.base_start, ARM.base_capsule.start)
    assert arm.base_radius == ARM.base_capsule.radius
    assert arm.contact_links == ARM.contact_links
    assert arm.self_pairs == self_pairs(ARM)


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
