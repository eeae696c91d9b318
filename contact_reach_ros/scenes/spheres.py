"""What a planner is told about the obstacles of a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.scenes.scene import Scene, SceneFile

Array = NDArray[np.float64]

FIXED_STIFFNESS = 1e5
"""Spring that stands for the fixture of a node, N/m: nothing that the arm may touch moves it."""


WALL_SPHERES = 12
"""Nodes of the walls that a plan looks at, the nearest ones."""


def sphere_capacity(file: SceneFile) -> int:
    """Number of spheres that a planner for these scenes has to look at."""
    if file.wall is not None:
        return WALL_SPHERES
    return 0 if file.ball is None else 1


def rest_positions(scene: Scene) -> Array:
    """Where nothing pushes the obstacles, (K, 3), m: balls, then the nodes of one wall after the other."""
    rests = [ball.center[None] for ball in scene.balls] + [wall.rest for wall in scene.walls]
    return np.concatenate(rests) if rests else np.zeros((0, 3))


def obstacle_spheres(scene: Scene, positions: Array) -> Spheres:
    """The obstacles of a scene at `positions` (K, 3), m, in the order of `rest_positions`."""
    radius = [ball.settings.radius for ball in scene.balls]
    stiffness = [ball.settings.stiffness for ball in scene.balls]
    damping = [ball.settings.damping for ball in scene.balls]
    edges, edge_stiffness = [np.zeros((0, 2), np.intp)], []
    for wall in scene.walls:
        settings = wall.settings
        edges.append(wall.edges + len(radius))
        edge_stiffness += [settings.planner_edge_stiffness] * len(wall.edges)
        radius += [settings.node_radius] * len(wall.rest)
        damping += [settings.damping] * len(wall.rest)
        stiffness += np.where(wall.fixed, FIXED_STIFFNESS, settings.planner_anchor_stiffness).tolist()
    return Spheres(
        center=positions,
        rest=rest_positions(scene),
        radius=np.array(radius),
        stiffness=np.array(stiffness),
        damping=np.array(damping),
        edges=np.concatenate(edges),
        edge_stiffness=np.array(edge_stiffness),
    )
