"""The wall scene: two meshes that every posture at the target touches, and that elbow and forearm would push into."""

import functools

import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.placing import free_path, on_hand, on_middle, swivelled_segments
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.obstacle import WallSettings
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import rest_positions

SEEDS = range(3)
SETTINGS = WallSettings()


@functools.cache
def scene_of(seed: int) -> Scene:
    return make_scene(read_scene("wall"), ARM, seed)


@functools.cache
def path_of(seed: int) -> np.ndarray:
    path = free_path(RobotModel(ARM), scene_of(seed).start, scene_of(seed).target)
    assert path is not None
    return path


def test_two_lattices_stand_around_the_gap_with_the_rows_farthest_from_it_fixed():
    center = np.array([0.5, 0.1, 0.3])
    lower, upper = walls = SETTINGS.at(center)
    spacing = (np.array(SETTINGS.size) - 2 * SETTINGS.node_radius) / (np.array(SETTINGS.nodes) - 1)
    along_x, along_y, along_z = SETTINGS.nodes
    for wall in walls:
        extent = np.ptp(wall.rest, axis=0) + 2 * SETTINGS.node_radius
        np.testing.assert_allclose(extent, SETTINGS.size, rtol=0, atol=1e-12)
        np.testing.assert_allclose(wall.rest.mean(axis=0)[:2], center[:2], rtol=0, atol=1e-12)
        # Each edge joins neighbours along one axis, and none of them twice.
        steps = np.abs(wall.rest[wall.edges[:, 0]] - wall.rest[wall.edges[:, 1]])
        assert ((steps > 1e-9).sum(axis=1) == 1).all()
        np.testing.assert_allclose(steps.max(axis=1), spacing[steps.argmax(axis=1)])
        expected = (along_x - 1) * along_y * along_z + along_x * (along_y - 1) * along_z
        expected += along_x * along_y * (along_z - 1)
        assert len({frozenset(edge) for edge in wall.edges.tolist()}) == len(wall.edges) == expected
    bottom, top = lower.rest[:, 2].max() + SETTINGS.node_radius, upper.rest[:, 2].min() - SETTINGS.node_radius
    assert top - bottom == pytest.approx(SETTINGS.gap) and (top + bottom) / 2 == pytest.approx(center[2])
    np.testing.assert_array_equal(lower.fixed, np.isclose(lower.rest[:, 2], lower.rest[:, 2].min()))
    np.testing.assert_array_equal(upper.fixed, np.isclose(upper.rest[:, 2], upper.rest[:, 2].max()))


@pytest.mark.parametrize("seed", SEEDS)
def test_walls_stand_in_the_way_between_start_and_target(seed):
    scene, path = scene_of(seed), path_of(seed)
    start, _ = RobotModel(ARM).tip_pose(scene.start)
    half = 0.5 * SETTINGS.size[0]
    for wall in scene.obstacles:
        x = wall.rest[:, 0].mean()
        assert start[0] <= x - half + 1e-9
        assert x + half + 0.06 <= scene.target[0] + 1e-3
    nodes, radius = rest_positions(scene), SETTINGS.node_radius
    depths = overlap_depths(ARM, *capsule_segments(ARM, path), nodes, radius)
    assert depths[0].max() <= -0.01
    deepest = depths.max(axis=(0, 2))
    # Placement looks at every fifth pose of the path only.
    assert 0.04 <= deepest[on_middle(ARM)].max() <= 0.155
    assert deepest[on_hand(ARM)].max() <= 0.025
    # No posture that holds the target pose is free of contact. What planning in the null space is for: with the elbow
    # aside the sum over all nodes of the depth in the arm is much smaller.
    holding = overlap_depths(ARM, *swivelled_segments(ARM, path[-1], np.linspace(0, 2 * np.pi, 721)), nodes, radius)
    assert holding.max(axis=(1, 2)).min() > 0.0
    pushed = np.maximum(holding.max(axis=1), 0.0).sum(axis=1)
    assert pushed.min() < 0.4 * pushed[0]
