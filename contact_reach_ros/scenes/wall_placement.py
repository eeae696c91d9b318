"""Where the two walls stand: between start and target, around the hand's way, in the way of elbow and forearm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.scenes.lattice import make_walls
from contact_reach_ros.scenes.overlap import (
    HAND_LINKS,
    LINKS,
    MIDDLE_LINKS,
    RADII,
    overlap_depths,
    path_segments,
    swivelled_segments,
)
from contact_reach_ros.scenes.scene import Wall, WallSettings

Array = NDArray[np.float64]

_TRIES = 40
_SPREAD = 0.01
"""How far the gap's centre may be above or below that of the hand that passes, m."""
_PATH_STEP = 5
_SWIVELS = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)


def place_walls(path: Array, settings: WallSettings, random: np.random.Generator) -> tuple[Wall, Wall] | None:
    """Walls for the arm's free path (N, 7); None if none fit.

    The start is free of them, the target lies behind them, elbow or forearm would push into them on the free path, and
    no posture that holds the target pose is free of contact, so that there is no collision-free path.

    Raises
    ------
    SceneError
        If the mesh is too fine or does not fit into the walls.
    """
    starts, ends = path_segments(np.concatenate([path[:-1:_PATH_STEP], path[-1:]]))
    swivelled = swivelled_segments(path[-1], _SWIVELS)
    hand, middle = np.isin(LINKS, HAND_LINKS), np.isin(LINKS, MIDDLE_LINKS)
    points = np.concatenate([starts[:, hand], ends[:, hand]], axis=1)
    radii = np.tile(RADII[hand], 2)
    hand_middles = 0.5 * ((points[..., 2] + radii).max(axis=1) + (points[..., 2] - radii).min(axis=1))
    hand_x = ends[:, -1, 0]
    half_thickness = 0.5 * settings.size[0]
    nearest, farthest = hand_x[0] + half_thickness, hand_x[-1] - half_thickness - settings.target_clearance
    if nearest > farthest:
        return None
    for _ in range(_TRIES):
        x = random.uniform(nearest, farthest)
        z = hand_middles[np.abs(hand_x - x).argmin()] + random.uniform(-_SPREAD, _SPREAD)
        walls = make_walls(settings, np.array([x, 0.0, z]))
        nodes = np.concatenate([wall.rest for wall in walls])
        if overlap_depths(starts[0], ends[0], nodes, settings.node_radius).max() > -settings.start_clearance:
            continue
        deepest = overlap_depths(starts, ends, nodes, settings.node_radius).max(axis=(0, 2))
        fits = settings.min_overlap <= deepest[middle].max() <= settings.max_overlap
        fits = fits and deepest[hand].max() <= settings.max_hand_overlap
        if fits:
            squeezes = overlap_depths(*swivelled, nodes, settings.node_radius).max(axis=(1, 2))
            if squeezes.min() >= settings.min_squeeze:
                return walls
    return None
