"""Concrete scenes from a scene file and a seed."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.checks import check_reach, conflict, given_obstacles
from contact_reach_ros.scenes.free_path import free_path
from contact_reach_ros.scenes.overlap import (
    HAND_LINKS,
    LINKS,
    MIDDLE_LINKS,
    RADII,
    base_distances,
    overlap_depths,
    path_segments,
)
from contact_reach_ros.scenes.scene import Ball, BallSettings, Scene, SceneFile
from contact_reach_ros.scenes.wall_placement import place_walls

Array = NDArray[np.float64]

_TARGET_TRIES = 200
_WALL_TARGET_TRIES = 20
_BALL_TRIES = 200
_FOAM = 1
"""Tells the random numbers of the foam from those of the places."""
_MIN_SWEEP = 0.05
"""A part of the arm that moves less than this, m, cannot be blocked by a ball."""


def make_scene(file: SceneFile, seed: int, target: Array | None = None) -> Scene:
    """Draw a target and place the obstacles so that the arm's free path meets them, unless the file places them.

    Parameters
    ----------
    file
        From `read_scene`.
    seed
        The same seed gives the same scene. Only what the file leaves open is drawn from it.
    target
        Flange position (3,), m, instead of the file's or a random one.

    Raises
    ------
    SceneError
        If a target is given that cannot be reached or is inside an obstacle, an obstacle lies in the arm at the start,
        or no target or no place for the obstacle was found; the message says what to change.
    """
    random = np.random.default_rng(seed)
    model = RobotModel()
    start = np.array(file.target.start)
    origin, _ = model.flange_pose(start)
    given = file.target.position if target is None else target
    wanted = None if given is None else np.asarray(given, float)
    path = None
    if wanted is not None:
        check_reach(wanted)
        path = free_path(model, start, wanted)
        if path is None:
            raise SceneError(
                f"target {np.round(wanted, 3).tolist()} m cannot be reached on a straight line from the start with the "
                "orientation held: it is near a singularity or a joint limit; choose another target"
            )
    # Looking for a place for walls takes long.
    tries = _TARGET_TRIES if file.wall is None else _WALL_TARGET_TRIES
    reason = ""
    for _ in range(tries):
        drawn = random.uniform(file.target.minimum, file.target.maximum) if wanted is None else wanted
        if wanted is None:
            is_far = np.linalg.norm(drawn - origin) >= file.target.min_distance
            path = free_path(model, start, drawn) if is_far else None
        if path is None:
            continue
        scene = _with_obstacles(Scene(file.name, seed, start, drawn), file, path, random)
        if scene is None:
            continue
        reason = conflict(scene)
        if not reason:
            return dataclasses.replace(scene, mismatch=file.mismatch, foam_scale=_foam_scale(file, seed))
        if wanted is not None and any(given_obstacles(file)):
            raise SceneError(f"scene '{file.name}': {reason}")
    raise SceneError(f"scene '{file.name}', seed {seed}: {_nothing_found(file, tries, wanted is None, reason)}")


def _nothing_found(file: SceneFile, tries: int, is_drawn: bool, reason: str) -> str:
    """What was looked for, and what to change; `reason` is why the last scene was refused, if one was."""
    what = "target"
    if file.ball is not None:
        what = "target with a ball on the arm's path"
    elif file.wall is not None:
        what = "target with walls on the arm's path"
    remedy = "widen the target's box" if is_drawn else "choose another target"
    if file.wall is not None and file.wall.center is None:
        remedy += (
            f", or the walls' limits: gap = {file.wall.gap:g} m, overlap {file.wall.min_overlap:g} to "
            f"{file.wall.max_overlap:g} m, max_hand_overlap = {file.wall.max_hand_overlap:g} m"
        )
    found = f"no {what} found in {tries} tries"
    return f"{found} (the last: {reason}); {remedy}" if reason else f"{found}; {remedy}"


def _foam_scale(file: SceneFile, seed: int) -> float:
    """Drawn apart from the rest, so that a scene with and without mismatch is otherwise the same."""
    variation = file.mismatch.foam_variation
    return float(np.random.default_rng((seed, _FOAM)).uniform(1.0 - variation, 1.0 + variation))


def _with_obstacles(scene: Scene, file: SceneFile, path: Array, random: np.random.Generator) -> Scene | None:
    """The scene with its obstacles, where the file says or on the arm's free path (N, 7); None if nothing fits."""
    balls, walls = given_obstacles(file)
    if balls or walls:
        return dataclasses.replace(scene, balls=balls, walls=walls)
    if file.ball is not None:
        center = _place_ball(path, file.ball, random)
        return None if center is None else dataclasses.replace(scene, balls=(Ball(center, file.ball),))
    if file.wall is not None:
        placed = place_walls(path, file.wall, random)
        return None if placed is None else dataclasses.replace(scene, walls=placed)
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
        if fits and base_distances(center) > settings.radius:
            return center
    return None
