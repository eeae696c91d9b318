"""Obstacles as planners see them: spheres held by springs and rigid bodies, and those of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Array, checked_array
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.rigid import Environment
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import SceneFile, anywhere


@dataclass(frozen=True)
class Spheres:
    """Obstacles in the base frame: rigid bodies, and spheres slowed by a damper and held to their rest by a spring.

    Edges join the spheres of a deformable body. An edge pulls the difference of its ends' displacements from rest back
    to zero, in all directions alike. A sphere without a spring of its own must be joined to one that has.

    Raises
    ------
    InputError
        If a value is not finite, the shapes disagree, a radius, damping or edge stiffness is not positive, a stiffness
        is negative, an edge names a sphere that does not exist, or a group of joined spheres has no spring to hold it.
    """

    center: Array
    """(K, 3) present positions of the spheres, m."""
    rest: Array
    """(K, 3) positions that their springs pull them to, m."""
    radius: Array
    """(K,), m."""
    stiffness: Array
    """(K,) of the spring that pulls to the rest position, N/m."""
    damping: Array
    """(K,) of the motion through the surroundings, N s/m."""
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    """(E, 2) indices of the spheres that each edge joins."""
    edge_stiffness: Array = field(default_factory=lambda: np.zeros(0))
    """(E,) N/m."""
    environment: Environment = ()
    """Rigid bodies, which the arm must not touch."""

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.radius))
        for name, shape in (("center", (count, 3)), ("rest", (count, 3))):
            object.__setattr__(self, name, checked_array(f"sphere {name}", getattr(self, name), shape))
        edges = np.array(self.edges, dtype=np.intp).reshape(-1, 2)
        object.__setattr__(self, "edges", edges)
        sizes = {"radius": count, "stiffness": count, "damping": count, "edge_stiffness": len(edges)}
        for name, size in sizes.items():
            values = checked_array(f"sphere {name}", getattr(self, name), (size,))
            if (values < 0.0).any() or (name != "stiffness" and (values == 0.0).any()):
                raise InputError(f"sphere {name}: expected positive values, got {values.min():g}")
            object.__setattr__(self, name, values)
        if edges.size and not (edges.min() >= 0 and edges.max() < count):
            raise InputError(
                f"sphere edges: expected indices from 0 to {count - 1}, got {edges.min()} to {edges.max()}"
            )
        self._check_held()

    def __len__(self) -> int:
        return len(self.radius)

    def _check_held(self) -> None:
        if (self.stiffness > 0.0).all():
            return
        # Imported where it is needed: a third of the start of processes that never have such spheres.
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = len(self)
        graph = coo_array((np.ones(len(self.edges)), self.edges.T), shape=(count, count))
        groups, group = connected_components(graph, directed=False)
        held = np.zeros(groups, bool)
        held[group[self.stiffness > 0.0]] = True
        if not held.all():
            loose = int(np.flatnonzero(~held[group])[0])
            raise InputError(
                f"sphere stiffness: nothing holds sphere {loose}; expected a positive stiffness of it or of a sphere "
                "that edges join it to"
            )

    @classmethod
    def none(cls, environment: Environment = ()) -> Spheres:
        """No obstacles but rigid ones."""
        empty = np.zeros(0)
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), empty, empty, empty, environment=environment)


FIXED_STIFFNESS = 1e5
"""Spring that stands for the fixture of a node, N/m: nothing that the arm may touch moves it noticeably."""

MAX_SPHERES = 12
"""Greatest number of a scene's spheres that a plan takes into account: the nearest ones."""


def sphere_capacity(scene: SceneFile | Scene) -> int:
    """Number of spheres that a planner for such scenes has to take into account."""
    obstacles = scene.obstacles if isinstance(scene, Scene) else anywhere(scene)
    return min(sum(len(obstacle.rest) for obstacle in obstacles), MAX_SPHERES)


def rest_positions(scene: Scene) -> Array:
    """Positions of the obstacles' spheres when nothing pushes them, (K, 3), m, one obstacle after the other."""
    return np.concatenate([np.zeros((0, 3)), *(obstacle.rest for obstacle in scene.obstacles)])


def obstacle_spheres(scene: Scene, positions: Array) -> Spheres:
    """The obstacles of a scene at `positions` (K, 3), m, in the order of `rest_positions`."""
    radius: list[float] = []
    stiffness: list[float] = []
    damping: list[float] = []
    edges, edge_stiffness = [np.zeros((0, 2), np.intp)], []
    for obstacle in scene.obstacles:
        material, count = obstacle.material, len(obstacle.rest)
        edges.append(obstacle.edges + len(radius))
        edge_stiffness += obstacle.edge_stiffness.tolist()
        radius += [obstacle.radius] * count
        damping += [material.damping] * count
        stiffness += np.where(obstacle.fixed, FIXED_STIFFNESS, material.stiffness).tolist()
    return Spheres(
        center=positions,
        rest=rest_positions(scene),
        radius=np.array(radius),
        stiffness=np.array(stiffness),
        damping=np.array(damping),
        edges=np.concatenate(edges),
        edge_stiffness=np.array(edge_stiffness),
        environment=scene.environment,
    )
