"""Concrete scenes from a scene file and a seed."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.free_path import free_path
from contact_reach_ros.scenes.overlap import HAND_LINKS, LINKS, MIDDLE_LINKS, RADII, overlap_depths, path_segments
from contact_reach_ros.scenes.scene import Ball, BallSettings, Scene, SceneFile
from contact_reach_ros.scenes.wall_placement import place_walls

Array = NDArray[np.float64]

_TARGET_TRIES = 200
_WALL_TARGET_TRIES = 20
_BALL_TRIES = 200
_MIN_SWEEP = 0.05
"""A part of the arm that moves less than this, m, cannot be blocked by a ball."""


def make_scene(file: SceneFile, seed: int, target: Array | None = None) -> Scene:
    """Draw a target and place the obstacles so that the arm's free path meets them.

    Parameters
    ----------
    file
        From `read_scene`.
    seed
        The same seed gives the same scene.
    target
        Flange position (3,), m, instead of a random one.

    Raises
    ------
    SceneError
        If no target or no place for the obstacle was found; the message says what to change.
    """
    random = np.random.default_rng(seed)
    model = RobotModel()
    start = np.array(file.target.start)
    origin, _ = model.flange_pose(start)
    # Looking for a place for walls takes long.
    tries = _TARGET_TRIES if file.wall is None else _WALL_TARGET_TRIES
    for _ in range(tries):
        drawn = (
            random.uniform(file.target.minimum, file.target.maximum) if target is None else np.asarray(target, float)
        )
        path = None
        if target is not None or np.linalg.norm(drawn - origin) >= file.target.min_distance:
            path = free_path(model, start, drawn)
        if path is not None:
            scene = _with_obstacles(Scene(file.name, seed, start, drawn), file, path, random)
            if scene is not None:
                return scene
        if target is not None and path is None:
            raise SceneError(
                f"target {np.round(drawn, 3).tolist()} m cannot be reached on a straight line from the start with the "
                "orientation held: it is out of reach, near a singularity or a joint limit; choose another target"
            )
    what = "target"
    if file.ball is not None:
        what = "target with a ball on the arm's path"
    elif file.wall is not None:
        what = "target with walls on the arm's path"
    remedy = "widen the target's box" if target is None else "choose another target"
    if file.wall is not None:
        remedy += (
            f", or the walls' limits: gap = {file.wall.gap:g} m, overlap {file.wall.min_overlap:g} to "
            f"{file.wall.max_overlap:g} m, max_hand_overlap = {file.wall.max_hand_overlap:g} m"
        )
    raise SceneError(f"scene '{file.name}', seed {seed}: no {what} found in {tries} tries; {remedy}")


def _with_obstacles(scene: Scene, file: SceneFile, path: Array, random: np.random.Generator) -> Scene | None:
    """The scene with what its file asks for, placed on the arm's free path (N, 7); None if nothing fits."""
    if file.ball is not None:
        center = _place_ball(path, file.ball, random)
        return None if center is None else dataclasses.replace(scene, balls=(Ball(center, file.ball),))
    if file.wall is not None:
        walls = place_walls(path, file.wall, random)
        return None if walls is None else dataclasses.replace(scene, walls=walls)
    return scene


def _place_ball(path: Array, settings: BallSettings, random: np.random.Generator) -> Array | None:
    """A centre (3,) that elbow or forearm would run into on the path, hand and start would not; None if none fits."""
    starts, ends = path_segments(path)
    middle, hand = np.isin(LINKS, MIDDLE_LINKS), np.isin(LINKS, HAND_LINKS)
    for _ in range(_BALL_TRIES):
        capsule = int(random.choice(np.flatnonzero(middle)))
        moment = int(random.uniform(0.3, 0.9) * len(path))
        along = random.uniform()
        points = starts[:, capsule] + along * (ends - starts)[:, capsule]
        if np.linalg.norm(points[moment] - points[0]) < _MIN_SWEEP:
            continue
        axis = ends[moment, capsule] - starts[moment, capsule]
        direction = points[moment] - points[moment - 5]
        direction -= axis * (direction @ axis) / (axis @ axis)
        direction /= max(float(np.linalg.norm(direction)), 1e-9)
        reach = RADII[capsule] + settings.radius - random.uniform(settings.min_overlap, settings.max_overlap)
        center = points[moment] + reach * direction
        depths = overlap_depths(starts, ends, center[None], settings.radius)[..., 0]
        deepest = depths.max(axis=0)
        fits = settings.min_overlap <= deepest[middle].max() <= settings.max_overlap
        fits = fits and deepest[hand].max() <= -settings.hand_clearance
        fits = fits and depths[0].max() <= -settings.start_clearance
        fits = fits and deepest[~middle & ~hand].max() <= 0.0
        if fits and _base_distance(center) > settings.radius:
            return center
    return None


def _base_distance(center: Array) -> float:
    capsule = iiwa14.BASE_CAPSULE
    height = np.clip(center[2], capsule.start[2], capsule.end[2])
    return float(np.linalg.norm(center - (0.0, 0.0, height))) - capsule.radius
