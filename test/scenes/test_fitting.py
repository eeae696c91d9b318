"""Scenes for other arms: everything in proportion, and a start from which the arm gets to the targets."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.fitting import fitted, with_gap
from contact_reach_ros.scenes.generate import load_scene, make_scene
from contact_reach_ros.scenes.placing import free_path, postures_at
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.scene_file import read_scene

OTHERS = [name for name in ARMS if name != ARM.name]


def test_lengths_are_in_proportion_and_places_stay(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("base: ball\ntarget: {position: [0.5, 0.1, 0.3]}\nball: {center: [0.4, 0.4, 0.4], radius: 0.2}\n")
    file, arm = read_scene(str(path)), load_arm("ur10")
    factor, scene = arm.reach / ARM.reach, fitted(file, arm)
    (ball,), (before,) = scene.obstacles, file.obstacles
    assert ball.radius == pytest.approx(factor * 0.2) and ball.mass == before.mass
    assert ball.center == before.center and scene.target.position == file.target.position
    np.testing.assert_allclose(scene.target.maximum, factor * np.array(file.target.maximum))
    path.write_text("base: ball\ntarget: {reach: 0}\n")
    assert fitted(read_scene(str(path)), arm) == read_scene(str(path))


@pytest.mark.parametrize("arm", OTHERS)
def test_targets_are_where_the_arm_gets_with_the_orientation_held(arm):
    scene = load_scene("ball", arm=load_arm(arm), seed=1)
    assert free_path(RobotModel(scene.arm), scene.start, scene.target) is not None
    assert np.linalg.norm(scene.target - link_frames(scene.arm, scene.start)[1][-1]) > 0.19 * scene.arm.reach


def test_the_rule_for_the_gap_gives_that_of_the_arm_that_the_scene_is_for():
    file = read_scene("wall")
    (walls,), target = file.obstacles, file.target
    middle = 0.5 * (np.array(target.minimum) + np.array(target.maximum))
    rotations, _ = link_frames(ARM, target.start_of(ARM))
    found = with_gap(walls, ARM, postures_at(ARM, middle, rotations[-1]))
    assert found.gap == pytest.approx(walls.gap, abs=0.003)


def test_an_arm_with_a_bent_wrist_does_not_get_through_without_pushing_either():
    scene = make_scene(read_scene("wall"), load_arm("xarm7"), 0)
    rotations, origins = link_frames(scene.arm, free_path(RobotModel(scene.arm), scene.start, scene.target)[-1])
    seeds = np.random.default_rng(1).uniform(scene.arm.lower, scene.arm.upper, (200, scene.arm.n))
    postures = solve_ik(scene.arm, origins[-1], rotations[-1], seeds, 0.05)
    nodes, radius = np.concatenate([each.rest for each in scene.obstacles]), scene.obstacles[0].radius
    depths = overlap_depths(scene.arm, *capsule_segments(scene.arm, postures), nodes, radius).max(axis=(1, 2))
    assert depths.min() > 0.0
    assert depths.max() > 0.05


def test_an_arm_without_a_start_is_told_so():
    arm = load_arm("panda")
    stiff = [
        dataclasses.replace(joint, lower=home - 0.6, upper=home + 0.6)
        for joint, home in zip(arm.joints, arm.home, strict=True)
    ]
    with pytest.raises(SceneError, match=r"no posture of arm 'panda' was found .*; give target.start"):
        make_scene(read_scene("wall"), dataclasses.replace(arm, joints=tuple(stiff)), 0)
