"""Box-shaped lattices of spheres, joined by edges along the lattice."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import SceneError
from contact_reach_ros.world.kinds.limits import check_stiffness
from contact_reach_ros.world.obstacle import Material

MAX_FREE_NODES = 200
MAX_NODES = 300
"""Greatest numbers of movable nodes in a scene, and of all; with more, the simulation would not keep its step of
1 ms: at these limits a step takes up to 0.35 ms in contact."""


@dataclass(frozen=True)
class Lattice:
    """A lattice of spheres that fills a box.

    Attributes
    ----------
    size
        Size of the box along x, y, z, m: the surfaces of the outer spheres touch its sides.
    nodes
        Numbers of spheres along x, y, z, at least 2 each.
    radius
        Radius of a sphere, m.
    """

    size: tuple[float, ...]
    nodes: tuple[int, ...]
    radius: float

    def points(self, center: Array) -> Array:
        """Centres of the spheres (N, 3), m, z counting fastest, of a box around `center` (3,)."""
        extents = 0.5 * np.array(self.size) - self.radius
        axes = [np.linspace(-extent, extent, count) for extent, count in zip(extents, self.nodes, strict=True)]
        return center + np.array(list(itertools.product(*axes)))

    def edges(self) -> NDArray[np.intp]:
        """Pairs (E, 2) of neighbours along the three axes."""
        index = np.arange(np.prod(self.nodes)).reshape(self.nodes)
        along = (np.moveaxis(index, axis, 0) for axis in range(3))
        return np.concatenate([np.stack([line[:-1].ravel(), line[1:].ravel()], axis=1) for line in along])

    def level(self, number: int) -> NDArray[np.bool_]:
        """(N,) true for the spheres on one level along z; -1 is the top."""
        mask = np.zeros(self.nodes, bool)
        mask[:, :, number] = True
        return mask.ravel()

    def check(self, kind: str, bodies: str, material: Material, copies: int = 1) -> None:
        """Refuse a lattice with one fixed level if `copies` of it, the `bodies`, cannot be simulated.

        Raises `SceneError` if it has too many nodes, its springs are too stiff for the nodes' mass, or the nodes
        overlap.
        """
        along_x, along_y, along_z = self.nodes
        count, free = copies * along_x * along_y * along_z, copies * along_x * along_y * (along_z - 1)
        if free > MAX_FREE_NODES or count > MAX_NODES:
            raise SceneError(
                f"{kind}: nodes = {self.nodes} makes {count} nodes in {bodies}, {free} of which can move; the "
                f"simulation keeps 1 kHz with at most {MAX_NODES} and {MAX_FREE_NODES}: use a coarser mesh"
            )
        # The eigenvalues of the mesh are at most twice the sum over the edges of one node (Gershgorin).
        edges = sum(min(number - 1, 2) for number in self.nodes)
        stiffness = 2.0 * edges * material.edge_stiffness + material.stiffness + material.contact_stiffness
        check_stiffness(kind, stiffness, material.mass)
        for axis, size, count in zip("xyz", self.size, self.nodes, strict=True):
            if (size - 2.0 * self.radius) / (count - 1) < 2.0 * self.radius - 1e-9:
                raise SceneError(
                    f"{kind}: {count} nodes of radius {self.radius:g} m along {axis} do not fit side by side into "
                    f"{size:g} m: use fewer or smaller nodes"
                )
