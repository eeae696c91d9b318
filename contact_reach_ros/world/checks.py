"""Scenes that are refused: obstacles in the arm, targets in obstacles or out of reach."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.workspace import unreachable
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import InputError, SceneError
from contact_reach_ros.world.collision import check_hand, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import Obstacle, bodies
from contact_reach_ros.world.overlap import (
    base_distances,
    capsule_links,
    capsule_segments,
    on_hand,
    on_middle,
    overlap_depths,
)
from contact_reach_ros.world.scene import Scene, SceneFile, TargetSettings

_TOLERANCE = 1e-9
"""m."""


def check_placement(file: SceneFile, arm: Arm) -> None:
    """Refuse a scene that is impossible for this arm with any seed.

    Raises
    ------
    SceneError
        If the scene is impossible; the message gives the numbers and what to change.
    SettingsError
        If the start is not within the limits of the arm's joints, or the arm has no such inertia set.
    """
    target = file.target
    arm.inertias(file.mismatch.inertia_set)
    start = target.start_of(arm)
    for section in file.obstacles:
        if section.center is None and not (on_middle(arm).any() and on_hand(arm).any()):
            raise SceneError(
                f"{section.KIND}: it would be placed by the capsules of middle links and hand, and arm '{arm.name}' "
                f"lacks them on one of these; give {section.KIND}.center"
            )
    if target.position is None:
        _check_box(arm, target)
    else:
        check_reach(arm, np.array(target.position))
    # Without a target of its own, the scene is checked only at the start.
    position = np.full(3, np.nan) if target.position is None else np.array(target.position)
    scene = Scene(file.name, arm, 0, start, position, given_obstacles(file), environment=file.environment)
    reason = conflict(scene)
    if reason:
        raise SceneError(reason)


def _check_box(arm: Arm, target: TargetSettings) -> None:
    shoulder = np.array(arm.shoulder)
    nearest = np.clip(shoulder, target.minimum, target.maximum)
    if np.linalg.norm(nearest - shoulder) > arm.reach:
        raise SceneError(
            f"target: the nearest point of the box from minimum = {list(target.minimum)} to maximum = "
            f"{list(target.maximum)} {unreachable(arm, nearest)}; move the box"
        )


def check_reach(arm: Arm, target: Array) -> None:
    """Refuse a target (3,), m, that is out of reach or inside the base.

    Raises `SceneError` if it is; the message gives the distance.
    """
    reason = unreachable(arm, target)
    if reason:
        name = f"target {np.round(target, 3).tolist()} m"
        raise SceneError(f"{name} cannot be reached: its position {reason}; choose another target")


def given_obstacles(file: SceneFile) -> tuple[Obstacle, ...]:
    """The obstacles whose place is in the file."""
    given = [section for section in file.obstacles if section.center is not None]
    return bodies(given, [np.array(section.center) for section in given])


def conflict(scene: Scene) -> str:
    """Why a scene is impossible, with the numbers; empty if it is possible.

    An obstacle lies in the arm or its base at the start, or the arm in a rigid body or itself; the flange would be
    inside an obstacle at the target; or the hand, in the orientation of the start, would be inside a rigid body or a
    fixed node there.
    """
    arm = scene.arm
    rigid = _rigid_conflict(scene)
    if rigid:
        return rigid
    starts, ends = capsule_segments(arm, scene.start)
    shift = scene.target - link_frames(arm, scene.start)[1][-1]
    moved = starts + shift, ends + shift
    reasons = (
        _start_conflict(arm, obstacle, starts, ends) or _target_conflict(arm, obstacle, scene.target, *moved)
        for obstacle in scene.obstacles
    )
    return next(filter(None, reasons), "")


def _rigid_conflict(scene: Scene) -> str:
    """How the arm lies in a rigid body or itself at the start, or the hand does at the target; empty if it does not."""
    arm = scene.arm
    for pair in nearest(arm, scene.start[None], scene.environment):
        if pair.distance < -_TOLERANCE:
            return f"at the start {pair}; move that body in section environment, or change target.start"
    if not np.isfinite(scene.target).all():
        return ""
    try:
        check_hand(arm, Target(scene.target, link_frames(arm, scene.start)[0][-1]), scene.environment)
    except InputError as error:
        return str(error)
    return ""


def _sphere(obstacle: Obstacle, index: int) -> str:
    """Describe one sphere in words."""
    place = f"at {np.round(obstacle.rest[index], 3).tolist()} m, radius {obstacle.radius:g} m"
    if not obstacle.lattice:
        return f"{obstacle.name} ({place})"
    node = tuple(int(number) for number in np.unravel_index(index, obstacle.lattice))
    return f"node {node} of {obstacle.name} ({place})"


def _remedy(obstacle: Obstacle) -> str:
    return f"move {obstacle.kind}.center, or change"


def _start_conflict(arm: Arm, obstacle: Obstacle, starts: Array, ends: Array) -> str:
    """How an obstacle lies in the arm's capsules, (C, 3) each, or in its base; empty if it does not."""
    depths = np.concatenate(
        [
            overlap_depths(arm, starts, ends, obstacle.rest, obstacle.radius),
            (obstacle.radius - base_distances(arm, obstacle.rest))[None],
        ]
    )
    part, index = np.unravel_index(depths.argmax(), depths.shape)
    depth = depths[part, index]
    if depth <= _TOLERANCE:
        return ""
    links = capsule_links(arm)
    link = arm.link_names[links[part] - 1] if part < len(links) else arm.base_frame
    return (
        f"at the start {link} lies {1000 * depth:.1f} mm deep in {_sphere(obstacle, int(index))}; "
        f"{_remedy(obstacle)} target.start"
    )


def _target_conflict(arm: Arm, obstacle: Obstacle, target: Array, starts: Array, ends: Array) -> str:
    """As `_start_conflict`, at the target; a target of NaN conflicts with nothing."""
    name = f"target {np.round(target, 3).tolist()} m"
    depths = obstacle.radius - np.linalg.norm(obstacle.rest - target, axis=1)
    index = int(depths.argmax())
    if depths[index] > _TOLERANCE:
        return (
            f"{name} lies {1000 * depths[index]:.1f} mm inside {_sphere(obstacle, index)}; {_remedy(obstacle)} "
            "the target"
        )
    if not obstacle.fixed.any():
        return ""
    in_hand = overlap_depths(arm, starts, ends, obstacle.rest, obstacle.radius)[on_hand(arm)]
    deepest = np.where(obstacle.fixed, in_hand.max(axis=0, initial=-np.inf), -np.inf)
    index = int(deepest.argmax())
    if deepest[index] > _TOLERANCE:
        return (
            f"{name}: there the hand lies {1000 * deepest[index]:.1f} mm deep in {_sphere(obstacle, index)}, which is "
            f"fixed; {_remedy(obstacle)} the target"
        )
    return ""
