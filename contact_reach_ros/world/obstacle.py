"""Obstacles of any kind: bodies of soft spheres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array


@dataclass(frozen=True)
class Material:
    """Properties of each sphere of an obstacle and of the edges between its spheres.

    Attributes
    ----------
    mass
        Mass of a sphere, kg.
    stiffness
        Stiffness of the spring that holds a sphere in place, N/m.
    damping
        Damping of a sphere's motion, N s/m.
    contact_stiffness
        Contact stiffness of the surface, N/m.
    friction
        Sliding friction coefficient.
    edge_stiffness
        k of the spring along an edge, N/m.
    hardening
        h: a simulated edge of length l whose ends have moved apart by s has the stiffness k (1 + h (s / l)²).
    planner_scale
        Factor on `stiffness` and `edge_stiffness` in the planner's model, which does not harden.
    """

    mass: float
    stiffness: float
    damping: float
    contact_stiffness: float
    friction: float
    edge_stiffness: float = 0.0
    hardening: float = 0.0
    planner_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One body of a concrete scene: spheres of one radius and material, held by springs and joined by edges.

    An edge resists any change of the vector between its ends, in all directions alike.

    Attributes
    ----------
    kind
        Key of its section in the scene file.
    name
        Name in messages to the user, such as 'the lower wall'.
    rest
        (K, 3) centres of the spheres when nothing pushes them, m, base frame.
    radius
        Radius of each sphere, m.
    material
        Material of spheres and edges.
    fixed
        (K,) true for the spheres that cannot move.
    id
        Number that is unique in its scene.
    edges
        (E, 2) indices of the spheres that each edge joins; none by default.
    lattice
        Numbers of spheres along x, y and z if they form a lattice, z counting fastest; else empty.
    """

    kind: str
    name: str
    rest: Array
    radius: float
    material: Material
    fixed: NDArray[np.bool_]
    id: int = 0
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    lattice: tuple[int, ...] = ()

    @property
    def is_deformable(self) -> bool:
        """Whether it is a mesh of joined spheres, rather than spheres that move on their own."""
        return len(self.edges) > 0
