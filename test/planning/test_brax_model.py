"""The Brax system is the one source of the transfer model, and loading it says nothing."""

import dataclasses

import jax
import numpy as np
from arm_simulation import ARM, HOME
from planning_helpers import FLANGE, SMALL, make_objective, make_problem

from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.planning.transfer import model
from contact_reach_ros.planning.transfer.model import arm_model, load_system


def test_loading_is_silent(capfd, recwarn):
    load_system(build_mjcf(ARM))
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")
    assert not recwarn.list


def test_capsules_are_those_of_the_table_to_the_last_digit():
    arm = arm_model(ARM)
    np.testing.assert_array_equal(arm.capsule_start, [capsule.start for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_axis, [np.subtract(each.end, each.start) for each in ARM.capsules])
    np.testing.assert_array_equal(arm.capsule_radius, [capsule.radius for capsule in ARM.capsules])
    np.testing.assert_array_equal(arm.base_start, ARM.base_capsule.start)
    assert arm.base_radius == ARM.base_capsule.radius
    assert arm.contact_links == ARM.contact_links
    assert arm.self_pairs == self_pairs(ARM)


def test_the_model_is_the_arm_of_the_mjcf(monkeypatch, quick_compilation):
    """A forearm that is 0.1 m longer, and a tip that is elsewhere, change the file alone."""
    joints = list(ARM.joints)
    joints[4] = dataclasses.replace(joints[4], offset=(0.0, 0.2845, 0.0))
    other = dataclasses.replace(ARM, joints=tuple(joints), tip_offset=(0.02, 0.0, 0.1))
    monkeypatch.setattr(model, "build_mjcf", lambda arm: build_mjcf(other))
    arm_model.cache_clear()
    try:
        objective = make_objective()
    finally:
        arm_model.cache_clear()
    push = np.full((SMALL.horizon, 13, 1), 0.005)
    rollout = jax.jit(objective.roll_out)(make_problem(HOME, FLANGE, None), push)
    for q, position in zip(rollout.q[..., 0], rollout.pose.position[..., 0], strict=True):
        q = np.asarray(q, float)
        np.testing.assert_allclose(position, link_frames(other, q)[1][-1], rtol=0, atol=1e-5)
        assert np.linalg.norm(position - link_frames(ARM, q)[1][-1]) > 0.05
