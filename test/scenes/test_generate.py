"""Generated scenes: targets that can be reached and balls that are in the way of the middle links only."""

import dataclasses
import functools

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, POSITION_LIMITS, mobility, with_obstacle

from contact_reach_ros.arm import Arm, Inertia
from contact_reach_ros.arm.capsules import shape_segments
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.placing import MIN_MOBILITY, free_path, least_mobility
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import TargetSettings, read_scene
from contact_reach_ros.world.spheres import rest_positions

SEEDS = range(3)
TOLERANCE = 1e-6


@functools.cache
def scene_of(name: str, seed: int) -> Scene:
    return make_scene(read_scene(name), ARM, seed)


@functools.cache
def path_of(name: str, seed: int) -> np.ndarray:
    scene = scene_of(name, seed)
    path = free_path(RobotModel(ARM), scene.start, scene.target)
    assert path is not None
    return path


@pytest.mark.parametrize("name", ["free", "ball"])
@pytest.mark.parametrize("seed", SEEDS)
def test_target_lies_in_its_box_and_can_be_reached(name, seed):
    scene, settings = scene_of(name, seed), read_scene(name).target
    assert (scene.target >= settings.minimum).all()
    assert (scene.target <= settings.maximum).all()
    model = RobotModel(ARM)
    origin, rotation = model.tip_pose(scene.start)
    assert np.linalg.norm(scene.target - origin) >= settings.min_distance
    assert np.linalg.norm(scene.target - ARM.shoulder) <= ARM.reach
    position, final_rotation = model.tip_pose(path_of(name, seed)[-1])
    np.testing.assert_allclose(position, scene.target, rtol=0, atol=1e-3)
    assert np.linalg.norm(pin.log3(final_rotation @ rotation.T)) < 1e-2


@pytest.mark.parametrize("seed", SEEDS)
def test_ball_is_in_the_way_of_the_middle_links_only(seed):
    scene = scene_of("ball", seed)
    (ball,) = scene.obstacles
    starts, ends = shape_segments(ARM, scene.start[None])
    assert overlap_depths(ARM, starts, ends, ball.rest, ball.radius)[0, 0] <= TOLERANCE
    segments = capsule_segments(ARM, path_of("ball", seed))
    depths = overlap_depths(ARM, *segments, ball.rest, ball.radius)[..., 0]
    assert depths[0].max() <= -0.01 + TOLERANCE
    links, deepest = np.array([capsule.link for capsule in ARM.capsules]), depths.max(axis=0)
    assert 0.02 - TOLERANCE <= deepest[(links >= 3) & (links <= 5)].max() <= 0.05 + TOLERANCE
    assert deepest[links > 5].max() <= -0.02 + TOLERANCE
    assert deepest[links == 2].max() <= TOLERANCE


def test_same_seed_same_scene():
    first, second = scene_of("ball", 3), make_scene(read_scene("ball"), ARM, 3)
    np.testing.assert_array_equal(first.target, second.target)
    np.testing.assert_array_equal(first.obstacles[0].rest, second.obstacles[0].rest)


def test_a_target_without_a_straight_way_is_refused_only_where_an_obstacle_has_to_be_placed_on_it():
    """Goals on goal_pose are refused by `check_goal` alone."""
    behind = np.array([-0.6, 0.0, 0.3])
    np.testing.assert_array_equal(make_scene(read_scene("free"), ARM, 0, behind).target, behind)
    with pytest.raises(SceneError, match=r"ball cannot be placed .* straight line .* choose another target"):
        make_scene(read_scene("ball"), ARM, 0, behind)


def test_box_without_targets_is_refused_with_what_to_change():
    file = read_scene("free")
    box = TargetSettings(min_distance=1.5)
    with pytest.raises(SceneError, match=r"free\.yaml: seed 3: no target found .*widen the box of the target"):
        make_scene(dataclasses.replace(file, target=box), ARM, 3)


class TestWhatTheFilePlaces:
    TARGET, CENTER = (0.5, 0.2, 0.3), (0.55, -0.2, 0.5)

    def file(self, position=None, center=None, name="ball"):
        file = read_scene(name)
        target = dataclasses.replace(file.target, position=position)
        return with_obstacle(dataclasses.replace(file, target=target), center=center)

    def test_a_ball_stands_where_the_file_says(self):
        scene = make_scene(self.file(self.TARGET, self.CENTER), ARM, 3)
        np.testing.assert_array_equal(scene.target, self.TARGET)
        np.testing.assert_array_equal(scene.obstacles[0].rest[0], self.CENTER)

    def test_walls_stand_where_the_file_says(self):
        placed = scene_of("wall", 0)
        center = np.concatenate([wall.rest for wall in placed.obstacles]).mean(axis=0)
        file = with_obstacle(read_scene("wall"), center=tuple(center))
        scene = make_scene(file, ARM, 5)
        for one, other in zip(scene.obstacles, placed.obstacles, strict=True):
            np.testing.assert_allclose(one.rest, other.rest, rtol=0, atol=1e-12)
        assert not np.array_equal(scene.target, placed.target)

    def test_commanded_target_in_the_ball_is_refused_with_how_deep(self):
        inside = np.add(self.CENTER, (0.0, 0.0, -0.07))
        with pytest.raises(SceneError, match=r"ball\.yaml: target .* lies 30\.0 mm inside the ball .* in place of the"):
            make_scene(self.file(center=self.CENTER), ARM, 0, inside)

    def test_hand_in_the_fixture_at_the_target_is_refused(self):
        scene = scene_of("wall", 0)
        # The fixed row of the lower wall stands beside the flange.
        lower = scene.obstacles[0]
        fixture = lower.rest[lower.fixed][np.linalg.norm(lower.rest[lower.fixed] - scene.target, axis=1).argmin()]
        center = rest_positions(scene).mean(axis=0)
        center += scene.target - fixture + np.array([0.0, 0.045, 0.0])
        moved = with_obstacle(read_scene("wall"), center=tuple(center))
        with pytest.raises(SceneError, match=r"the hand lies .* mm deep in .* which is fixed"):
            make_scene(moved, ARM, 0, scene.target)


class TestFoamOfAMismatch:
    def test_is_drawn_apart_so_that_everything_else_stays(self):
        for seed in range(3):
            plain, mismatched = scene_of("ball", seed), scene_of("ball_mismatch", seed)
            np.testing.assert_array_equal(mismatched.target, plain.target)
            np.testing.assert_array_equal(mismatched.obstacles[0].rest, plain.obstacles[0].rest)
            assert plain.foam_scale == 1.0

    def test_fills_the_declared_range(self):
        file = read_scene("ball_mismatch")
        file = dataclasses.replace(
            file, obstacles=(), target=dataclasses.replace(file.target, position=(0.5, 0.2, 0.3))
        )
        scales = np.array([make_scene(file, ARM, seed).foam_scale for seed in range(40)])
        assert 0.7 <= scales.min() < 0.75 and 1.25 < scales.max() <= 1.3


def test_the_free_path_is_straight_and_stays_away_from_limits_and_singularities():
    model = RobotModel(ARM)
    for seed in range(5):
        scene, path = scene_of("free", seed), path_of("free", seed)
        origin, rotation = model.tip_pose(scene.start)
        direction = (scene.target - origin) / np.linalg.norm(scene.target - origin)
        assert (np.abs(path) <= POSITION_LIMITS - 0.2).all()
        for q in path:
            model.update(q, np.zeros(ARM.n))
            aside = (model.position - origin) - ((model.position - origin) @ direction) * direction
            assert np.linalg.norm(aside) < 2e-3
            assert np.linalg.norm(pin.log3(model.rotation @ rotation.T)) < 0.02
            assert np.linalg.eigvalsh(mobility(model))[0] > 0.04


def heavier(factor: float) -> Arm:
    """The iiwa 14 with all masses, inertias and rotors so many times as heavy."""
    links = [
        Inertia(factor * link.mass, link.center, tuple(factor * moment for moment in link.tensor))
        for link in ARM.inertias()
    ]
    joints = tuple(dataclasses.replace(joint, armature=factor * joint.armature) for joint in ARM.joints)
    return dataclasses.replace(ARM, joints=joints, inertia_sets={"nominal": tuple(links)})


def test_a_heavy_arm_has_the_scenes_of_a_light_one():
    assert [least_mobility(load_arm(name)) for name in ARMS] == [MIN_MOBILITY] * len(ARMS)
    heavy = heavier(20.0)
    assert least_mobility(heavy) == pytest.approx(MIN_MOBILITY / 20.0, rel=0.02)
    for name in ("free", "ball", "wall"):
        np.testing.assert_allclose(make_scene(read_scene(name), heavy, 0).target, scene_of(name, 0).target, atol=1e-12)


def test_why_no_target_was_found_is_said_with_the_joint():
    file, wrist = read_scene("free"), ARM.joints[5]
    joints = (*ARM.joints[:5], dataclasses.replace(wrist, lower=0.55, upper=1.0), ARM.joints[6])
    with pytest.raises(SceneError, match=r"\d+ times joint 'lbr_A6' comes within 0.2 rad of its l"):
        make_scene(file, dataclasses.replace(ARM, joints=joints), 0)
    stretched = dataclasses.replace(ARM, home=(0.0, 0.3, 0.0, 0.0, 0.0, 0.5, 0.0))
    with pytest.raises(SceneError, match=r"\d+ times the arm starts near a singularity: its m"):
        make_scene(file, stretched, 0)
