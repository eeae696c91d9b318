"""Scenes for other arms than the one that their lengths were chosen for."""

from __future__ import annotations

import dataclasses
import functools
from typing import TypeVar

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import Arm, Array, link_frames, link_frames_of_many
from contact_reach_ros.arm.capsules import moving, pair_distances, self_pairs, shape_radii, shape_segments
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import standing
from contact_reach_ros.arm.rotations import frame_about
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.placing import capsule_links, free_path, on_hand, postures_at, target_clearance
from contact_reach_ros.settings import Settings
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import ObstacleSettings, WallSettings
from contact_reach_ros.world.scene_file import SceneFile, TargetSettings

_PLACES = ("center", "position")
"""Lengths that say where something is: they stay as they are."""
_RAISES = (0.0, 0.15, 0.3)
"""How far start and targets are raised until an arm gets from one to the other, as shares of its reach."""
_PROBES = 6
"""Targets that are tried from a start."""
_REACHED = 5
"""Of these, those that must be reached."""
_X_TO_Z = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Permutation of the axes that makes z of x."""
_ROLLS = 8
_SEEDS = 60
_STARTS = 60
"""Postures that are tried as starts."""
_LIMIT_MARGIN = 0.25
"""Least distance of joints from their limits at the start, rad."""
_GAP_SHARE = 0.94
"""The gap of walls, as a share of the least height at which the arm gets through."""
_FOREARM_LINK = 4
_POINTS = np.linspace(0.0, 1.0, 21)
"""Where heights along a capsule are measured, as shares of its length."""

S = TypeVar("S", bound=Settings)


def fitted(file: SceneFile, arm: Arm) -> SceneFile:
    """The scene for an arm, in its scene frame: all lengths but the places that it names in proportion to the reach.

    A scene without `target.reach`, or for an arm of this very reach that stands on its base frame, stays as it is.
    Raises `SceneError` if no start was found for the arm from which it gets to the targets.
    """
    target, mount = file.target, arm
    if target.reach == 0.0:
        return file
    arm = standing(mount)
    if arm is mount and target.reach == arm.reach:
        return file
    factor = arm.reach / target.reach
    scaled = dataclasses.replace(_scaled(target, factor), reach=arm.reach, start=None)
    if scaled.start_position is not None:
        found = _start(arm, scaled)
        if found is None:
            raise SceneError(
                f"no posture of arm '{arm.name}' was found from which its hand, pointing along x, "
                "gets from target.start_position into the targets' box; give target.start, minimum and maximum for it"
            )
        scaled = found
    start = scaled.start_of(arm)
    middle = 0.5 * (np.array(scaled.minimum) + np.array(scaled.maximum))
    postures = postures_at(arm, middle, link_frames(arm, start)[0][-1])
    postures = postures if len(postures) else start[None]
    obstacles = tuple(with_gap(_scaled(each, factor), arm, postures) for each in file.obstacles)
    return dataclasses.replace(file, target=scaled, obstacles=obstacles)


def with_gap(section: ObstacleSettings, arm: Arm, postures: Array) -> ObstacleSettings:
    """Walls with a gap that is as narrow for the arm as 0.15 m is for the iiwa 14; other obstacles as they are.

    The gap follows from that of `postures` (N, n), rad, in which the part of the arm that is in the walls or behind
    them is lowest, when the target is as near as it may be: with an iiwa's elbow aside, the height of its hand.
    """
    if not isinstance(section, WallSettings):
        return section
    depth = section.size[0] + target_clearance(arm)
    return dataclasses.replace(section, gap=_GAP_SHARE * min(_height(arm, q, depth) for q in postures))


def _height(arm: Arm, q: Array, depth: float) -> float:
    """Height of the part of hand and forearm that is at most `depth` behind the tip along x, in a posture (n,), m."""
    starts, ends = capsule_segments(arm, q)
    beyond, radii = capsule_links(arm) >= min(_FOREARM_LINK, arm.n), shape_radii(arm)[moving(arm), None]
    points = starts[:, None] + _POINTS[:, None] * (ends - starts)[:, None]
    counts = beyond[:, None] & (points[..., 0] >= link_frames(arm, q)[1][-1][0] - depth)
    above, below = points[..., 2] + radii, points[..., 2] - radii
    return float(above[counts].max(initial=-np.inf) - below[counts].min(initial=np.inf))


def _scaled(settings: S, factor: float) -> S:
    """Settings with all lengths multiplied by a factor, as far as their ranges permit."""
    values = {}
    for entry in settings.declared():
        value = getattr(settings, entry.name)
        if entry.unit == "m" and entry.name not in _PLACES and value is not None:
            numbers = np.clip(factor * np.array(value), entry.minimum, entry.maximum)
            values[entry.name] = tuple(numbers.tolist()) if isinstance(value, tuple) else float(numbers)
    return dataclasses.replace(settings, **values)


@functools.cache
def _start(arm: Arm, target: TargetSettings) -> TargetSettings | None:
    """Targets with a start of the arm at or above `start_position`, and raised as much; None if there is none."""
    random = np.random.default_rng(0)
    probes = random.uniform(target.minimum, target.maximum, (_PROBES, 3))
    seeds = random.uniform(np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi), (_SEEDS, arm.n))
    model = RobotModel(arm)
    for share in _RAISES:
        up = np.array([0.0, 0.0, share * arm.reach])
        for start in _postures(arm, np.array(target.start_position) + up, seeds):
            missed = 0
            for probe in probes + up:
                try:
                    free_path(model, start, probe)
                except SceneError:
                    missed += 1
                if missed > _PROBES - _REACHED:
                    break
            else:
                box = {key: tuple((np.array(getattr(target, key)) + up).tolist()) for key in ("minimum", "maximum")}
                return dataclasses.replace(target, start=tuple(start.tolist()), **box)  # type: ignore[arg-type]
    return None


def _postures(arm: Arm, position: Array, seeds: Array) -> Array:
    """Postures (N, n) with the tip at a position (3,), m, and the last joint's axis along x.

    Those with a flat hand come first, and of these those with a high elbow. In none does the arm touch itself.
    """
    rotations, _ = link_frames(arm, arm.home)
    out = rotations[-2][:, 2] if arm.tip_offset[2] >= 0.0 else -rotations[-2][:, 2]
    # Inverse of the smallest rotation that turns x, or z in permuted axes, into it.
    forward = (_X_TO_Z.T @ frame_about(_X_TO_Z @ out) @ _X_TO_Z).T @ rotations[-1]
    rolls = [pin.rpy.rpyToMatrix(angle, 0.0, 0.0) for angle in 2.0 * np.pi / _ROLLS * np.arange(_ROLLS)]
    goals = [Target(position, roll @ forward).of_task(arm.task) for roll in rolls]
    found = np.concatenate(
        [solve_ik(arm, position, goal.rotation, seeds, _LIMIT_MARGIN, goal.only_axis) for goal in goals]
    )
    pairs = np.array(self_pairs(arm)).reshape(-1, 2)
    if not len(found) or not len(pairs):
        return found
    found = found[pair_distances(arm, found, pairs).min(axis=1) > 0.0]
    hand = np.flatnonzero(on_hand(arm)) + moving(arm).start
    heights, radius = np.stack(shape_segments(arm, found))[:, :, hand, 2], shape_radii(arm)[hand]
    thickness = (heights + radius).max(axis=(0, 2)) - (heights - radius).min(axis=(0, 2))
    elbow = link_frames_of_many(arm, found)[1][:, 2].max(axis=0)
    is_wound = np.abs(found).max(axis=1) > np.pi
    return found[np.lexsort([-elbow, np.round(thickness, 2), is_wound])][:_STARTS]
