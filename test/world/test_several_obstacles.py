"""Obstacles of scenes: lists, ids, materials, boxes, and obstacles that are not where they are seen."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.world.obstacle import BallSettings, BoxSettings
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import MAX_SPHERES, rest_positions, sphere_capacity

LIST = """
target: {position: [0.5, 0.2, 0.3]}
obstacles:
  - {kind: ball, center: [0.7, -0.25, 0.5], radius: 0.08, stiffness: 400.0}
  - {kind: ball, center: [0.4, 0.6, 0.3], stiffness: 60.0}
  - {kind: box, center: [0.6, -0.6, 0.2], size: [0.1, 0.1, 0.2], nodes: [2, 2, 3], edge_stiffness: 90.0}
  - {kind: box, center: [0.6, 0.6, 0.2], size: [0.1, 0.2, 0.2], nodes: [2, 4, 3], angles: [0.0, 0.0, 0.5]}
"""


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")

    def read(content):
        file = folder / "own.yaml"
        file.write_text(content)
        return read_scene(str(file))

    return read


@pytest.fixture(scope="module")
def scene(read):
    return make_scene(read(LIST), ARM, 0)


def test_a_list_has_any_number_of_obstacles_of_each_kind(read, scene):
    file = read(LIST)
    assert [type(section) for section in file.obstacles] == [BallSettings, BallSettings, BoxSettings, BoxSettings]
    assert [obstacle.name for obstacle in scene.obstacles] == ["the ball 0", "the ball 1", "the box 2", "the box 3"]
    assert sphere_capacity(file) == sphere_capacity(scene) == 12


def test_a_list_replaces_that_of_its_base(read, tmp_path):
    below = tmp_path / "below.yaml"
    below.write_text(LIST)
    file = read(f"base: {below}\nobstacles: [{{kind: ball, center: [0.7, 0, 0.9]}}]")
    assert file.obstacles == (BallSettings(center=(0.7, 0.0, 0.9)),)
    assert file.target.position == (0.5, 0.2, 0.3)


def test_boxes_are_turned_about_their_centre(scene):
    box = scene.obstacles[3]
    np.testing.assert_allclose(box.rest.mean(axis=0), [0.6, 0.6, 0.2], atol=1e-12)
    lowest = box.rest[box.fixed]
    edge = lowest[1] - lowest[0]
    np.testing.assert_allclose(np.arctan2(-edge[0], edge[1]), 0.5)


def test_a_box_stands_where_the_file_says(read):
    file = read("box: {center: [0.5, -0.3, 0.2]}\n")
    scene = make_scene(file, ARM, 0)
    (box,) = scene.obstacles
    np.testing.assert_allclose(box.rest.mean(axis=0), (0.5, -0.3, 0.2))
    np.testing.assert_allclose(np.ptp(box.rest, axis=0) + 2 * box.radius, (0.2, 0.2, 0.3))
    np.testing.assert_array_equal(box.fixed, np.isclose(box.rest[:, 2], box.rest[:, 2].min()))
    assert sphere_capacity(file) == sphere_capacity(scene) == MAX_SPHERES


def test_every_obstacle_is_simulated_with_its_own_material(scene):
    plant = SimulatedRobot(scene).plant
    model = plant.model
    stiffness = {
        model.body(name).name: model.jnt_stiffness[model.body(name).jntadr[0]] for name in ("ball_0_0", "ball_1_0")
    }
    assert stiffness == {"ball_0_0": 400.0, "ball_1_0": 60.0}
    np.testing.assert_array_equal(plant.obstacle_positions(), rest_positions(scene))


class TestMisplaced:
    def test_obstacles_are_seen_beside_where_they_are(self):
        file = read_scene("ball_misplaced")
        offsets = []
        for seed in range(4):
            scene = make_scene(file, ARM, seed)
            plant = SimulatedRobot(scene).plant
            np.testing.assert_array_equal(plant.obstacle_positions(), rest_positions(scene))
            true = plant.data.body("ball_0_0").xpos
            np.testing.assert_allclose(true, rest_positions(scene)[0] + scene.offsets[0], atol=1e-12)
            offsets.append(np.linalg.norm(scene.offsets[0]))
            assert 0.5 <= scene.foam_scale <= 2.0
        assert 0.005 < max(offsets) <= 0.02

    def test_an_obstacle_that_would_begin_in_the_arm_is_where_it_is_seen(self):
        file = read_scene("ball_misplaced")
        far = dataclasses.replace(file.mismatch, placement_error=0.1)
        for seed in range(4):
            SimulatedRobot(make_scene(dataclasses.replace(file, mismatch=far), ARM, seed)).plant.step()
