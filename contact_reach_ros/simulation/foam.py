"""Forces of the springs between the spheres of obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array

from contact_reach_ros.arrays import Array
from contact_reach_ros.world.obstacle import Obstacle


class Foam:
    """Springs along the edges of all obstacles.

    Each is a spring joint as in the paper: it pulls the vector between its ends back to its value at rest, in all
    directions alike. Foam grows stiffer as it is squeezed, so the stiffness is k (1 + h (s / l)²), where the ends have
    moved apart or together by s, the spring is l long at rest and h is the hardening.
    """

    def __init__(self, obstacles: Sequence[Obstacle], scale: float = 1.0) -> None:
        """`scale`: factor on the stiffness of all springs."""
        rest = np.concatenate([obstacle.rest for obstacle in obstacles])
        free = ~np.concatenate([obstacle.fixed for obstacle in obstacles])
        first = np.cumsum([0, *(len(obstacle.rest) for obstacle in obstacles)])
        counts = [len(obstacle.edges) for obstacle in obstacles]
        edges = np.concatenate([obstacle.edges + start for obstacle, start in zip(obstacles, first, strict=False)])
        stiffness = np.repeat([scale * obstacle.material.edge_stiffness for obstacle in obstacles], counts)
        hardening = np.repeat([obstacle.material.hardening for obstacle in obstacles], counts)
        # An edge between two fixed spheres has no effect.
        kept = free[edges].any(axis=1)
        edges, stiffness, hardening = edges[kept], stiffness[kept], hardening[kept]
        self._count = int(free.sum())
        ends = np.where(free, np.cumsum(free) - 1, -1)[edges]
        rows, sides = np.nonzero(ends >= 0)
        self._stretch = csr_array(
            (np.where(sides == 0, 1.0, -1.0), (rows, ends[rows, sides])), shape=(len(edges), self._count)
        )
        """(E, M) matrix from the displacements of the movable spheres to the change of each edge's vector."""
        self._gather = csr_array(self._stretch.T)
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        self._stiffness = stiffness[:, None]
        self._slope = self._stiffness * (hardening / lengths**2)[:, None]

    def forces(self, displacements: Array) -> Array:
        """Forces on the movable spheres, (3 M,) N, at their displacements from rest, (3 M,) m."""
        change = self._stretch @ displacements.reshape(self._count, 3)
        square = np.einsum("ij,ij->i", change, change)[:, None]
        return -(self._gather @ ((self._stiffness + self._slope * square) * change)).ravel()
