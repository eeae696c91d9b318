"""Impossible scenes: obstacles in the arm, or targets in obstacles."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsules import shape_name, shape_segments
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import InputError
from contact_reach_ros.scenes.paths import on_hand
from contact_reach_ros.world.collision import check_hand, nearest, overlap_depths
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.scene import Scene

_TOLERANCE = 1e-9
"""m."""


def conflict(scene: Scene) -> str:
    """Why a scene is impossible, with the numbers; empty if it is possible.

    An obstacle lies in the arm or its base at the start, or the arm in a rigid body or itself; the flange would be
    inside an obstacle at the target; or the hand, in the orientation of the start, would be inside a rigid body or a
    fixed node there. A target of NaN conflicts with nothing.
    """
    reasons = (_conflict_with(obstacle, scene) for obstacle in scene.obstacles)
    return _rigid_conflict(scene) or next(filter(None, reasons), "")


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


def _conflict_with(obstacle: Obstacle, scene: Scene) -> str:
    """How an obstacle lies in the arm or base at the start, or where the flange is to go; empty if it does not."""
    arm, radius, remedy = scene.arm, obstacle.radius, f"move {obstacle.kind}.center, or change"
    starts, ends = (points[0] for points in shape_segments(arm, scene.start[None]))
    depths = overlap_depths(arm, starts, ends, obstacle.rest, radius)
    shape, index = np.unravel_index(depths.argmax(), depths.shape)
    if depths[shape, index] > _TOLERANCE:
        return (
            f"at the start {shape_name(arm, int(shape))} lies {1000 * depths[shape, index]:.1f} mm deep in "
            f"{_sphere(obstacle, int(index))}; {remedy} target.start"
        )
    name = f"target {np.round(scene.target, 3).tolist()} m"
    inside = radius - np.linalg.norm(obstacle.rest - scene.target, axis=1)
    index = inside.argmax()
    if inside[index] > _TOLERANCE:
        return f"{name} lies {1000 * inside[index]:.1f} mm inside {_sphere(obstacle, int(index))}; {remedy} the target"
    shift = scene.target - link_frames(arm, scene.start)[1][-1]
    moved = overlap_depths(arm, starts[1:] + shift, ends[1:] + shift, obstacle.rest, radius)
    in_hand: Array = np.where(obstacle.fixed, moved[on_hand(arm)].max(axis=0, initial=-np.inf), -np.inf)
    index = in_hand.argmax()
    if in_hand[index] > _TOLERANCE:
        return (
            f"{name}: there the hand lies {1000 * in_hand[index]:.1f} mm deep in {_sphere(obstacle, int(index))}, "
            f"which is fixed; {remedy} the target"
        )
    return ""


def _sphere(obstacle: Obstacle, index: int) -> str:
    """Describe one sphere in words."""
    return f"{obstacle.name} (at {np.round(obstacle.rest[index], 3).tolist()} m, radius {obstacle.radius:g} m)"
