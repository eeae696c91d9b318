"""Concrete scenes from a scene file and a seed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.scenes.free_path import free_path
from contact_reach_ros.scenes.scene import Ball, BallSettings, Scene, SceneFile

Array = NDArray[np.float64]

_TARGET_TRIES = 200
_BALL_TRIES = 200
_MIDDLE_LINKS = (3, 4, 5)
_HAND_LINKS = (6, 7)
_MIN_SWEEP = 0.05
"""A part of the arm that moves less than this, m, cannot be blocked by a ball."""

_RADII = np.array([capsule.radius for capsule in iiwa14.CAPSULES])
_LINKS = np.array([capsule.link for capsule in iiwa14.CAPSULES])


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
    for _ in range(_TARGET_TRIES):
        drawn = (
            random.uniform(file.target.minimum, file.target.maximum) if target is None else np.asarray(target, float)
        )
        path = None
        if target is not None or np.linalg.norm(drawn - origin) >= file.target.min_distance:
            path = free_path(model, start, drawn)
        if path is not None:
            if file.ball is None:
                return Scene(file.name, seed, start, drawn, ())
            center = _place_ball(path, file.ball, random)
            if center is not None:
                return Scene(file.name, seed, start, drawn, (Ball(center, file.ball),))
        if target is not None and path is None:
            raise SceneError(
                f"target {np.round(drawn, 3).tolist()} m cannot be reached on a straight line from the start with the "
                "orientation held: it is out of reach, near a singularity or a joint limit; choose another target"
            )
    what = "target" if file.ball is None else "target with a ball on the arm's path"
    remedy = "widen the target's box" if target is None else "choose another target"
    raise SceneError(f"scene '{file.name}', seed {seed}: no {what} found in {_TARGET_TRIES} tries; {remedy}")


def capsule_segments(q: Array) -> tuple[Array, Array]:
    """Start and end points of the arm's capsules in the base frame, (6, 3) each, m."""
    rotations, origins = link_frames(q)
    starts, ends = [], []
    for capsule in iiwa14.CAPSULES:
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        starts.append(origin + rotation @ capsule.start)
        ends.append(origin + rotation @ capsule.end)
    return np.array(starts), np.array(ends)


def overlap_depths(starts: Array, ends: Array, center: Array, radius: float) -> Array:
    """How deep a sphere lies in each capsule, (..., 6), m; negative values are distances.

    `starts` and `ends` are (..., 6, 3), `center` (3,).
    """
    axis = ends - starts
    share = np.sum((center - starts) * axis, axis=-1) / np.sum(axis * axis, axis=-1)
    nearest = starts + np.clip(share, 0.0, 1.0)[..., None] * axis
    return _RADII + radius - np.linalg.norm(nearest - center, axis=-1)


def _place_ball(path: Array, settings: BallSettings, random: np.random.Generator) -> Array | None:
    """A centre (3,) that elbow or forearm would run into on the path, hand and start would not; None if none fits."""
    segments = [capsule_segments(q) for q in path]
    starts, ends = np.array([pair[0] for pair in segments]), np.array([pair[1] for pair in segments])
    middle, hand = np.isin(_LINKS, _MIDDLE_LINKS), np.isin(_LINKS, _HAND_LINKS)
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
        reach = _RADII[capsule] + settings.radius - random.uniform(settings.min_overlap, settings.max_overlap)
        center = points[moment] + reach * direction
        depths = overlap_depths(starts, ends, center, settings.radius)
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
