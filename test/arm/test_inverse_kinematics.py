"""Postures at a goal."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, WITH_TOOL

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.inverse_kinematics import solve_ik

LIMITS = np.array(ARM.upper)
ROTATIONS, ORIGINS = link_frames(ARM, HOME)
POSITION = ORIGINS[-1] + np.array([0.05, 0.2, -0.1])


def seeds(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-LIMITS, LIMITS, (count, 7))


@pytest.mark.parametrize(
    ("arm", "rotation"), [(ARM, ROTATIONS[-1]), (ARM, None), (WITH_TOOL, link_frames(WITH_TOOL, HOME)[0][-1])]
)
def test_solutions_are_at_the_goal_and_within_the_limits(arm, rotation):
    found = solve_ik(arm, POSITION, rotation, seeds(200), 0.1)
    assert len(found) > 50
    assert (np.abs(found) <= LIMITS - 0.1 + 1e-12).all()
    for q in found:
        rotations, origins = link_frames(arm, q)
        assert np.linalg.norm(origins[-1] - POSITION) < 1e-4
        if rotation is not None:
            np.testing.assert_allclose(rotations[-1], rotation, rtol=0, atol=2e-3)


def test_of_one_axis_the_rotation_about_it_is_free():
    found = solve_ik(ARM, POSITION, ROTATIONS[-1], seeds(100), 0.1, only_axis=True)
    assert len(found) > 50
    poses = [link_frames(ARM, q) for q in found]
    for rotations, origins in poses:
        assert np.linalg.norm(origins[-1] - POSITION) < 1e-4
        np.testing.assert_allclose(rotations[-1][:, 2], ROTATIONS[-1][:, 2], rtol=0, atol=2e-3)
    along_x = [rotations[-1][:, 0] @ ROTATIONS[-1][:, 0] for rotations, _ in poses]
    assert min(along_x) < -0.9
    assert max(along_x) > 0.9
