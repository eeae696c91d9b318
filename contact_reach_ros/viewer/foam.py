"""Surface of a deformable body that is known as a cloud of nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from contact_reach_ros.arrays import Array
from contact_reach_ros.world.spheres import Spheres

Indices = NDArray[np.intp]

_LONGEST = 1.5
"""Longest side of a tetrahedron that belongs to the body, in lengths of the longest edge."""
_FLAT = 1e-3
"""Volume below which a tetrahedron counts as flat, in cubes of the longest edge."""


def bodies(spheres: Spheres) -> list[Indices]:
    """Indices of the spheres of each deformable body, which edges join."""
    count = len(spheres)
    if not len(spheres.edges):
        return []
    graph = coo_array((np.ones(len(spheres.edges)), spheres.edges.T), shape=(count, count))
    groups, group = connected_components(graph, directed=False)
    members = [np.flatnonzero(group == number) for number in range(groups)]
    return [indices for indices in members if len(indices) > 1]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles over the outer nodes of a body.

    Attributes
    ----------
    nodes
        (V,) indices of the nodes that are corners.
    faces
        (F, 3) indices of `nodes`, counterclockwise as seen from outside.
    """

    nodes: Indices
    faces: Indices

    def vertices(self, positions: Array, radius: float) -> Array:
        """Corners (V, 3), m, of the surface at a distance `radius` from the nodes, which are at `positions` (N, 3)."""
        points = positions[self.nodes]
        a, b, c = (points[self.faces[:, corner]] for corner in range(3))
        areas = np.cross(b - a, c - a)
        normals = np.zeros_like(points)
        for corner in range(3):
            np.add.at(normals, self.faces[:, corner], areas)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return points + radius * normals / np.maximum(lengths, 1e-12)


def surface(rest: Array, edges: Indices) -> Surface | None:
    """The surface of the nodes at `rest` (N, 3), m, joined by `edges` (E, 2); None for nodes that span no volume.

    Tetrahedra between near nodes fill the body (an alpha shape); triangles that belong to only one form its surface.
    """
    try:
        # Nodes of a lattice lie on common spheres; joggling makes their triangulation unique.
        corners = Delaunay(rest, qhull_options="QJ Pp").simplices
    except (QhullError, ValueError):
        return None
    longest = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1).max()
    points = rest[corners]
    sides = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1).max(axis=(1, 2))
    volumes = np.abs(np.linalg.det(points[:, 1:] - points[:, :1])) / 6.0
    kept = sides <= _LONGEST * np.sqrt(3.0) * longest
    corners, flat = corners[kept], volumes[kept] < _FLAT * longest**3
    while len(corners):
        faces = np.concatenate([np.delete(corners, corner, axis=1) for corner in range(4)])
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        outer = first[count == 1]
        # Joggled nodes of a plane side form flat tetrahedra on top of it; inside the body, flat ones fill gaps.
        peeled = np.zeros(len(corners), bool)
        peeled[outer % len(corners)] = True
        peeled &= flat
        if not peeled.any():
            break
        corners, flat = corners[~peeled], flat[~peeled]
    if not len(corners):
        return None
    faces, opposite = faces[outer], corners.T.ravel()[outer]
    a, b, c = (rest[faces[:, corner]] for corner in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), rest[opposite] - a) > 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    nodes, renumbered = np.unique(faces, return_inverse=True)
    return Surface(nodes, renumbered.reshape(faces.shape))
