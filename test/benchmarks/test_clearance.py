"""Distances of the arm from obstacles, at postures and along motions."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME

from benchmarks.baselines.clearance import ClearanceChecker
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.spheres import Spheres

FAR = np.array([[3.0, 0.0, 0.0]])


def spheres_at(centers: np.ndarray, radius: float = 0.05) -> Spheres:
    ones = np.ones(len(centers))
    return Spheres(centers, centers, radius * ones, 100 * ones, 30 * ones)


def test_motion_through_a_sphere_is_found_wherever_the_sphere_is():
    """Small spheres along the way of the elbow: none may slip through between two checks."""
    start, end = HOME - np.array([1.2, 0, 0, 0, 0, 0, 0]), HOME + np.array([1.2, 0, 0, 0, 0, 0, 0])
    for share in np.linspace(0.1, 0.9, 8):
        _, ends = capsule_segments(ARM, start + share * (end - start))
        checker = ClearanceChecker(ARM, spheres_at(ends[2][None], 0.005), 0.0, 0.02, start)
        assert not checker.motion_free(start, end)
    assert ClearanceChecker(ARM, spheres_at(FAR), 0.0, 0.02, start).motion_free(start, end)


def test_start_in_contact_is_refused_with_the_depth():
    _, ends = capsule_segments(ARM, HOME)
    with pytest.raises(PlanningError, match=r"the arm is \d+\.\d mm deep in an obstacle .* withdraw"):
        ClearanceChecker(ARM, spheres_at(ends[2][None]), 0.02, 0.02, HOME)
