"""Forces of the springs that join the nodes of the walls."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from contact_reach_ros.scenes.scene import Wall

Array = NDArray[np.float64]


class Foam:
    """Springs along the edges of all walls.

    Each is a spring joint as in the paper: it pulls the vector between its ends back to what it is at rest, in all
    directions alike. Foam grows stiffer as it is squeezed, so the stiffness is k (1 + h (s / l)²) where the ends have
    moved apart or together by s, the spring is l long at rest and h is the hardening.
    """

    def __init__(self, walls: Sequence[Wall], scale: float = 1.0) -> None:
        """`scale`: factor on the stiffness of all springs."""
        lengths, stiffnesses, hardenings, entries = [], [], [], []
        self._count = sum(int((~wall.fixed).sum()) for wall in walls)
        first = row = 0
        for wall in walls:
            settings = wall.settings
            free = ~wall.fixed
            # An edge between two fixed nodes has no effect.
            edges = wall.edges[free[wall.edges].any(axis=1)]
            column = np.where(free, first + np.cumsum(free) - 1, -1)
            ends = column[edges]
            for end, sign in ((0, 1.0), (1, -1.0)):
                kept = np.flatnonzero(ends[:, end] >= 0)
                entries.append((np.full(len(kept), sign), row + kept, ends[kept, end]))
            row += len(edges)
            lengths.append(np.linalg.norm(wall.rest[edges[:, 0]] - wall.rest[edges[:, 1]], axis=1))
            stiffnesses.append(np.full(len(edges), scale * settings.edge_stiffness))
            hardenings.append(np.full(len(edges), settings.hardening))
            first += int(free.sum())
        values, rows, columns = (np.concatenate(part) for part in zip(*entries, strict=True))
        self._stretch = csr_array((values, (rows, columns)), shape=(row, self._count))
        """(E, M) from displacements of the nodes that can move to the change of each edge's vector."""
        self._gather = csr_array(self._stretch.T)
        self._stiffness = np.concatenate(stiffnesses)[:, None]
        self._slope = self._stiffness * (np.concatenate(hardenings) / np.concatenate(lengths) ** 2)[:, None]

    def forces(self, displacements: Array) -> Array:
        """Forces on the nodes that can move, (3 M,) N, at their displacements from rest, (3 M,) m."""
        change = self._stretch @ displacements.reshape(self._count, 3)
        square = np.einsum("ij,ij->i", change, change)[:, None]
        return -(self._gather @ ((self._stiffness + self._slope * square) * change)).ravel()
