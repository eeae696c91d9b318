"""A soft box stands where the file says and gives way to the arm."""

import numpy as np
import pytest
from arm_simulation import ARM, IDEAL_SENSORS

from benchmarks.press import press_in_model, press_in_plant
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.simulation.settings import JointSettings
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import MAX_SPHERES, obstacle_spheres, rest_positions, sphere_capacity


@pytest.fixture
def file(tmp_path):
    file = tmp_path / "box.yaml"
    file.write_text("box: {center: [0.5, -0.3, 0.2]}\n")
    return file


def test_the_box_stands_where_the_file_says_and_the_planner_knows_it(file):
    scene = make_scene(read_scene(str(file)), ARM, 0)
    (box,) = scene.obstacles
    np.testing.assert_allclose(box.rest.mean(axis=0), (0.5, -0.3, 0.2))
    np.testing.assert_allclose(np.ptp(box.rest, axis=0) + 2 * box.radius, (0.2, 0.2, 0.3))
    np.testing.assert_array_equal(box.fixed, np.isclose(box.rest[:, 2], box.rest[:, 2].min()))
    assert sphere_capacity(read_scene(str(file))) == sphere_capacity(scene) == MAX_SPHERES


def test_it_gives_way_as_the_planner_expects(file):
    scene = make_scene(read_scene(str(file)), ARM, 0)
    top, force = len(rest_positions(scene)) - 1, np.array([3.0, 0.0, 0.0])
    moved = press_in_plant(Plant(scene, IDEAL_SENSORS, JointSettings()), top, force, 2000)[-1]
    expected = press_in_model(obstacle_spheres(scene, rest_positions(scene)), top, force, np.array([np.inf]))[0]
    assert moved[0] > 0.01
    np.testing.assert_allclose(moved, expected, rtol=0.02, atol=1e-4)
