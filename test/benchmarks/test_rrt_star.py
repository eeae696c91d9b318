"""Collision-free paths: found where there are any, and not where there are none."""

import numpy as np
import pytest
from arm_simulation import ARM

from benchmarks.baselines.clearance import ClearanceChecker
from benchmarks.baselines.rrt_star import PathSettings, find_path
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

QUICK = PathSettings(searches=2, iterations=300, goal_samples=600)


def problem_of(scene: Scene) -> tuple[np.ndarray, Target, Spheres]:
    """Start, goal with the start's orientation held, and obstacles at rest."""
    rotations, _ = link_frames(ARM, scene.start)
    return scene.start, Target(scene.target, rotations[-1]), obstacle_spheres(scene, rest_positions(scene))


def test_path_around_a_ball_keeps_clear_and_ends_at_the_goal():
    seed = 2
    start, goal, spheres = problem_of(make_scene(read_scene("ball"), ARM, seed))
    path = find_path(ARM, start, goal, spheres, QUICK, seed)
    np.testing.assert_allclose(path.postures[0], start, rtol=0, atol=1e-6)
    rotations, origins = link_frames(ARM, path.postures[-1])
    np.testing.assert_allclose(origins[-1], goal.position, rtol=0, atol=2e-4)
    np.testing.assert_allclose(rotations[-1], goal.rotation, rtol=0, atol=2e-3)
    limits = np.array(ARM.upper) - QUICK.joint_margin
    checker = ClearanceChecker(ARM, spheres, 0.0, 0.02, start)
    nearest = min(checker.distances(start[None])[0], QUICK.clearance) - 0.5 * QUICK.resolution
    for a, b in zip(path.postures[:-1], path.postures[1:], strict=True):
        fine = a + np.linspace(0, 1, 200)[:, None] * (b - a)
        assert (np.abs(fine) <= limits + 1e-9).all()
        assert checker.distances(fine).min() >= nearest - 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "orientation"), [(0, "held"), (1, "free")])
def test_wall_scene_has_no_collision_free_path_and_without_walls_it_has(seed, orientation):
    """With no clearance asked for at all: among thousands of postures at the goal none is free, or none is reached."""
    start, goal, spheres = problem_of(make_scene(read_scene("wall"), ARM, seed))
    if orientation == "free":
        goal = Target(goal.position)
    thorough = PathSettings(clearance=0.0, goal_samples=3000, searches=3, iterations=2000)
    with pytest.raises(PlanningError, match=r"no collision-free (posture|path)"):
        find_path(ARM, start, goal, spheres, thorough, seed)
    assert find_path(ARM, start, goal, Spheres.none(), QUICK, seed).length > 0.0
