"""Distances of the arm from obstacles, at postures and along motions."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME

from benchmarks.baselines.clearance import ClearanceChecker
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.world.collision import capsule_segments, clearances, nearest
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.spheres import Spheres

LIMITS = np.array(ARM.upper)
FAR = np.array([[3.0, 0.0, 0.0]])


def spheres_at(centers: np.ndarray, radius: float = 0.05) -> Spheres:
    ones = np.ones(len(centers))
    return Spheres(centers, centers, radius * ones, 100 * ones, 30 * ones)


def postures(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-LIMITS, LIMITS, (count, ARM.n))


@pytest.mark.parametrize("count", [1, 64, 65])
def test_distances_are_those_of_the_planners_obstacle_reader(count):
    spheres = spheres_at(np.array([[0.5, 0.2, 0.4], [0.3, -0.6, 0.7], [-0.2, 0.5, 0.1]]))
    checker = ClearanceChecker(ARM, spheres, 0.0, 0.02, HOME)
    q = postures(count, count)
    expected = [clearances(ARM, posture, spheres).min() for posture in q]
    np.testing.assert_allclose(checker.distances(q), expected, rtol=0, atol=1e-6)


def test_postures_keep_clear_where_the_distance_is_the_clearance():
    floor = Plane("floor", (0.0, 0.0, 0.05))
    spheres = dataclasses.replace(spheres_at(np.array([[0.5, 0.2, 0.4]])), environment=(floor,))
    checker = ClearanceChecker(ARM, spheres, 0.03, 0.02, np.zeros(ARM.n))
    q = postures(0, 500)
    distances = checker.distances(q)
    rigid = np.array([pair.distance for pair in nearest(ARM, q, (floor,))])
    decided = (np.abs(distances - 0.03) > 1e-5) & (np.abs(rigid - 0.01) > 1e-5)
    expected = (distances >= 0.03) & (rigid >= 0.01)
    assert (expected != (distances >= 0.03)).sum() > 5
    np.testing.assert_array_equal(checker.free(q)[decided], expected[decided])


def test_motion_through_a_sphere_is_found_wherever_the_sphere_is():
    """Small spheres along the way of the elbow: none may slip through between two checks."""
    start, end = HOME - np.array([1.2, 0, 0, 0, 0, 0, 0]), HOME + np.array([1.2, 0, 0, 0, 0, 0, 0])
    for share in np.linspace(0.1, 0.9, 23):
        _, ends = capsule_segments(ARM, start + share * (end - start))
        checker = ClearanceChecker(ARM, spheres_at(ends[2][None], 0.005), 0.0, 0.02, start)
        assert not checker.motion_free(start, end)
    assert ClearanceChecker(ARM, spheres_at(FAR), 0.0, 0.02, start).motion_free(start, end)


def test_start_in_contact_is_refused_with_the_depth():
    _, ends = capsule_segments(ARM, HOME)
    with pytest.raises(PlanningError, match=r"the arm is \d+\.\d mm deep in an obstacle .* withdraw"):
        ClearanceChecker(ARM, spheres_at(ends[2][None]), 0.02, 0.02, HOME)
