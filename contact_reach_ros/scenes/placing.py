"""Places for obstacles on the arm's free path: a ball or walls in the way of elbow and forearm."""

from __future__ import annotations

from typing import cast

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsules import shape_radii, shape_segments
from contact_reach_ros.scenes.paths import holding_segments, on_hand, on_middle, path_segments
from contact_reach_ros.world.collision import overlap_depths
from contact_reach_ros.world.obstacle import BallSettings, ObstacleSettings, WallSettings

_REACH = 0.85
"""Reach of the iiwa 14, for which the lengths below were chosen, m; other arms have them in proportion."""
_START_CLEARANCE = 0.01
"""Least distance of the arm from obstacles at the start, m."""

_BALL_TRIES = 200
_MIN_SWEEP = 0.05
"""A ball cannot block a part of the arm that moves less than this, m, whatever its reach."""
_BALL_OVERLAP = (0.02, 0.05)
"""Least and greatest depth at which the free path enters the ball, m: noticed by the arm, within the contact budget."""
_HAND_CLEARANCE = 0.02
"""Least distance of the hand from the ball on the free path, m: only elbow and forearm are in its way."""

_WALL_TRIES = 40
_SPREAD = 0.01
"""How far the gap's centre may be above or below that of the passing hand, m, whatever its reach."""
_PATH_STEP = 5
_WALL_OVERLAP = (0.04, 0.15)
"""Least and greatest depth at which elbow and forearm enter a node on the free path, m."""
_MAX_HAND_OVERLAP = 0.02
"""Greatest depth at which the hand enters a node on the free path, m: it passes the gap with a squeeze."""
_MIN_SQUEEZE = 0.005
"""Least depth at which the arm enters a node in every posture that holds the target pose, m: none is free."""
_TARGET_CLEARANCE = 0.06
"""Least distance of the target behind the walls, m."""


def target_clearance(arm: Arm) -> float:
    """Least distance of a target behind the walls, m."""
    return arm.reach / _REACH * _TARGET_CLEARANCE


def place(section: ObstacleSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """The centre (3,), m, of a section's obstacles: its own, or a random one on the arm's free path (N, n), rad.

    None if no place on the path fits.
    """
    if section.center is not None:
        return np.array(section.center)
    if isinstance(section, BallSettings):
        return place_ball(section, arm, path, random)
    return place_walls(cast(WallSettings, section), arm, path, random)


def place_ball(ball: BallSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """A centre (3,) in the way of elbow or forearm on the path, but not of hand or start; None if none fits."""
    starts, ends = path_segments(arm, path)
    middle, hand = on_middle(arm), on_hand(arm)
    standing = shape_segments(arm, path[:1])
    scale = arm.reach / _REACH
    least, most = scale * _BALL_OVERLAP[0], scale * _BALL_OVERLAP[1]
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
        reach = shape_radii(arm)[1 + capsule] + ball.radius - random.uniform(least, most)
        center: Array = points[moment] + reach * direction
        depths = overlap_depths(arm, starts, ends, center[None], ball.radius)[..., 0]
        deepest = depths.max(axis=0)
        fits = least <= deepest[middle].max() <= most
        fits = fits and deepest[hand].max() <= -scale * _HAND_CLEARANCE
        fits = fits and depths[0].max() <= -scale * _START_CLEARANCE
        fits = fits and deepest[~middle & ~hand].max(initial=-np.inf) <= 0.0
        # The base is the first of the shapes.
        if fits and overlap_depths(arm, *standing, center[None], ball.radius)[0, 0, 0] < 0.0:
            return center
    return None


def place_walls(walls: WallSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """A centre of the gap (3,) on the hand's path; None if none fits.

    The start is clear of the walls, the target lies behind them, elbow or forearm would push into them on the path,
    and no posture that holds the target pose is free of contact, so that there is no collision-free path.
    """
    starts, ends = path_segments(arm, np.concatenate([path[:-1:_PATH_STEP], path[-1:]]))
    holding = holding_segments(arm, path[-1])
    hand, middle = on_hand(arm), on_middle(arm)
    points = np.concatenate([starts[:, hand], ends[:, hand]], axis=1)
    reach = np.tile(shape_radii(arm)[1:][hand], 2)
    hand_middles = 0.5 * ((points[..., 2] + reach).max(axis=1) + (points[..., 2] - reach).min(axis=1))
    hand_x = ends[:, hand][:, -1, 0]
    half_thickness, scale = 0.5 * walls.size[0], arm.reach / _REACH
    least, most = scale * _WALL_OVERLAP[0], scale * _WALL_OVERLAP[1]
    nearest, farthest = hand_x[0] + half_thickness, hand_x[-1] - half_thickness - target_clearance(arm)
    if nearest > farthest:
        return None
    for _ in range(_WALL_TRIES):
        x = random.uniform(nearest, farthest)
        z = hand_middles[np.abs(hand_x - x).argmin()] + random.uniform(-_SPREAD, _SPREAD)
        center = np.array([x, 0.0, z])
        nodes = np.concatenate([wall.rest for wall in walls.at(center)])
        if overlap_depths(arm, starts[0], ends[0], nodes, walls.node_radius).max() > -scale * _START_CLEARANCE:
            continue
        deepest = overlap_depths(arm, starts, ends, nodes, walls.node_radius).max(axis=(0, 2))
        fits = least <= deepest[middle].max() <= most
        fits = fits and deepest[hand].max() <= scale * _MAX_HAND_OVERLAP
        if fits:
            squeezes = overlap_depths(arm, *holding, nodes, walls.node_radius).max(axis=(1, 2))
            if squeezes.min() >= scale * _MIN_SQUEEZE:
                return center
    return None
