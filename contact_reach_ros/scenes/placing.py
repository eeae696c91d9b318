"""Places for obstacles on the arm's free path: a ball or walls in the way of elbow and forearm."""

from __future__ import annotations

from typing import cast

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsules import shape_radii, shape_segments
from contact_reach_ros.scenes.overlap import holding_segments, on_hand, on_middle, path_segments
from contact_reach_ros.world.collision import overlap_depths
from contact_reach_ros.world.obstacle_kinds import BallSettings, ObstacleSettings, WallSettings

_BALL_TRIES = 200
_MIN_SWEEP = 0.05
"""A ball cannot block a part of the arm that moves less than this, m."""
_WALL_TRIES = 40
_SPREAD = 0.01
"""How far the gap's centre may be above or below that of the passing hand, m."""
_PATH_STEP = 5


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
        reach = shape_radii(arm)[1 + capsule] + ball.radius - random.uniform(ball.min_overlap, ball.max_overlap)
        center: Array = points[moment] + reach * direction
        depths = overlap_depths(arm, starts, ends, center[None], ball.radius)[..., 0]
        deepest = depths.max(axis=0)
        fits = ball.min_overlap <= deepest[middle].max() <= ball.max_overlap
        fits = fits and deepest[hand].max() <= -ball.hand_clearance
        fits = fits and depths[0].max() <= -ball.start_clearance
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
    half_thickness = 0.5 * walls.size[0]
    nearest, farthest = hand_x[0] + half_thickness, hand_x[-1] - half_thickness - walls.target_clearance
    if nearest > farthest:
        return None
    for _ in range(_WALL_TRIES):
        x = random.uniform(nearest, farthest)
        z = hand_middles[np.abs(hand_x - x).argmin()] + random.uniform(-_SPREAD, _SPREAD)
        center = np.array([x, 0.0, z])
        nodes = np.concatenate([wall.rest for wall in walls.at(center)])
        if overlap_depths(arm, starts[0], ends[0], nodes, walls.node_radius).max() > -walls.start_clearance:
            continue
        deepest = overlap_depths(arm, starts, ends, nodes, walls.node_radius).max(axis=(0, 2))
        fits = walls.min_overlap <= deepest[middle].max() <= walls.max_overlap
        fits = fits and deepest[hand].max() <= walls.max_hand_overlap
        if fits:
            squeezes = overlap_depths(arm, *holding, nodes, walls.node_radius).max(axis=(1, 2))
            if squeezes.min() >= walls.min_squeeze:
                return center
    return None
