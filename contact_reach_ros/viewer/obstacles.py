"""Obstacles in the scene: balls, the nodes of deformable bodies and their surfaces, and rigid bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.drawing.parts import DARK, FOAM, NODE, RIGID
from contact_reach_ros.viewer.handles import as_bytes
from contact_reach_ros.world.rigid import Environment, slab
from contact_reach_ros.world.spheres import FIXED_STIFFNESS, Spheres

_LONGEST = 1.5
"""Longest side of a tetrahedron that belongs to a body, in lengths of the longest edge."""
_FLAT = 1e-3
"""Volume below which a tetrahedron counts as flat, in cubes of the longest edge."""
_COARSE, _FINE = (trimesh.creation.icosphere(subdivisions=steps) for steps in (1, 3))


Indices = NDArray[np.intp]


class ObstacleView:
    """Balls, the nodes of deformable bodies and their surfaces, and rigid bodies."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: Spheres | None = None
        self._spheres: Any = None
        # Of each deformable body: its nodes, the triangles between them, and the mesh.
        self._bodies: list[tuple[Indices, Indices, Any]] = []
        self._rigid: list[Any] = []
        self._environment: Environment = ()

    def show(self, spheres: Spheres | None) -> None:
        """Show obstacles; None for none."""
        shown = self._shown
        if spheres is shown:
            return
        self._show_rigid(() if spheres is None else spheres.environment)
        if shown is None or spheres is None or not _alike(spheres, shown):
            self._build(spheres)
        self._shown = spheres
        if spheres is None or not len(spheres):
            return
        self._spheres.batched_positions = spheres.center.astype(np.float32)
        for nodes, faces, handle in self._bodies:
            vertices = inflated(spheres.center[nodes], faces, float(spheres.radius[nodes[0]]))
            handle.vertices = vertices.astype(np.float32)

    def _show_rigid(self, environment: Environment) -> None:
        if environment == self._environment:
            return
        for handle in self._rigid:
            handle.remove()
        self._environment = environment
        self._rigid = [
            self._server.scene.add_box(
                f"/obstacles/rigid_{number}",
                color=as_bytes(RIGID),
                dimensions=tuple(shape.size),
                wxyz=np.roll(shape.orientation, 1),
                position=np.array(shape.center),
                opacity=0.5,
            )
            for number, shape in enumerate(map(slab, environment))
        ]

    def _build(self, spheres: Spheres | None) -> None:
        for handle in (self._spheres, *(handle for _, _, handle in self._bodies)):
            if handle is not None:
                handle.remove()
        self._spheres, self._bodies = None, []
        if spheres is None or not len(spheres):
            return
        scene = self._server.scene
        members = np.zeros(len(spheres), bool)
        for number, nodes in enumerate(_bodies(spheres)):
            members[nodes] = True
            renumbered = np.full(len(spheres), -1)
            renumbered[nodes] = np.arange(len(nodes))
            edges = renumbered[spheres.edges]
            faces = surface(spheres.rest[nodes], edges[(edges >= 0).all(axis=1)])
            if len(faces):
                handle = scene.add_mesh_simple(
                    f"/obstacles/surface_{number}",
                    inflated(spheres.center[nodes], faces, float(spheres.radius[nodes[0]])),
                    faces,
                    color=as_bytes(FOAM),
                    opacity=0.5,
                    flat_shading=True,
                    side="double",
                )
                self._bodies.append((nodes, faces, handle))
        fixed = members & (spheres.stiffness >= FIXED_STIFFNESS)
        colours = np.where(fixed[:, None], as_bytes(DARK), np.where(members[:, None], as_bytes(NODE), as_bytes(FOAM)))
        # Drawn at half their size, the nodes of a body leave its deformation visible.
        scales = np.where(members, 0.5, 1.0) * spheres.radius
        # There are hundreds of nodes, and not every browser has a fast graphics card.
        mesh = _COARSE if members.any() else _FINE
        self._spheres = scene.add_batched_meshes_simple(
            "/obstacles/spheres",
            mesh.vertices,
            mesh.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(spheres), 1)),
            batched_positions=spheres.center,
            batched_scales=scales.astype(np.float32),
            batched_colors=colours.astype(np.uint8),
            opacity=None if members.any() else 0.75,
            cast_shadow=not members.any(),
            lod="off",
        )


def _alike(spheres: Spheres, other: Spheres) -> bool:
    """Whether they differ only in their positions."""
    return all(np.array_equal(getattr(spheres, name), getattr(other, name)) for name in ("radius", "edges", "rest"))


def _bodies(spheres: Spheres) -> list[Indices]:
    """Indices of the spheres of each deformable body: those that edges join."""
    count = len(spheres)
    if not len(spheres.edges):
        return []
    graph = coo_array((np.ones(len(spheres.edges)), spheres.edges.T), shape=(count, count))
    groups, group = connected_components(graph, directed=False)
    members = [np.flatnonzero(group == number) for number in range(groups)]
    return [nodes for nodes in members if len(nodes) > 1]


def surface(rest: Array, edges: Indices) -> Indices:
    """Triangles (F, 3) over the outer nodes of a body, counterclockwise as seen from outside; none without a volume.

    Tetrahedra between near nodes fill the body (an alpha shape); triangles of only one tetrahedron form its surface.

    Parameters
    ----------
    rest
        (N, 3) nodes, m.
    edges
        (E, 2) pairs of nodes that are joined.
    """
    nothing = np.zeros((0, 3), np.intp)
    try:
        # Nodes of a lattice lie on common spheres; joggling makes their triangulation unique.
        corners = Delaunay(rest, qhull_options="QJ Pp").simplices
    except (QhullError, ValueError):
        return nothing
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
        return nothing
    faces, opposite = faces[outer], corners.T.ravel()[outer]
    a, b, c = (rest[faces[:, corner]] for corner in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), rest[opposite] - a) > 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return np.asarray(faces, np.intp)


def inflated(positions: Array, faces: Indices, radius: float) -> Array:
    """Corners (N, 3), m, of a surface with `faces` (F, 3) at a distance `radius` outside of the nodes (N, 3)."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return positions + radius * normals / np.maximum(lengths, 1e-12)
