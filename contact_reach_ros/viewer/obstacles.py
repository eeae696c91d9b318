"""Obstacles in the scene: balls, the nodes and edges of deformable bodies, and rigid bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser

from contact_reach_ros.palette import as_bytes
from contact_reach_ros.world.rigid import slab
from contact_reach_ros.world.spheres import FIXED_STIFFNESS, Spheres

_FOAM, _NODE, _FIXED, _RIGID = (as_bytes(colour) for colour in ("#6BCC94", "#1A8C59", "#383B40", "#99948C"))
_COARSE, _FINE = (trimesh.creation.icosphere(subdivisions=steps) for steps in (1, 3))


class ObstacleView:
    """Balls, the nodes and edges of deformable bodies, and rigid bodies."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        self._shown: Spheres | None = None
        self._handles: list[Any] = []
        self._spheres: Any = None
        self._edges: Any = None

    def show(self, spheres: Spheres | None) -> None:
        """Show obstacles; None for none."""
        shown = self._shown
        if spheres is shown:
            return
        self._shown = spheres
        if shown is None or spheres is None or not _alike(spheres, shown):
            for handle in self._handles:
                handle.remove()
            self._handles, self._spheres, self._edges = [], None, None
            if spheres is not None:
                self._build(spheres)
        elif self._spheres is not None:
            self._spheres.batched_positions = spheres.center.astype(np.float32)
            if self._edges is not None:
                self._edges.points = spheres.center[spheres.edges].astype(np.float32)

    def _build(self, spheres: Spheres) -> None:
        scene = self._scene
        self._handles = [
            scene.add_box(
                f"/obstacles/rigid_{number}",
                color=_RIGID,
                dimensions=tuple(shape.size),
                wxyz=np.roll(shape.orientation, 1),
                position=np.array(shape.center),
                opacity=0.5,
            )
            for number, shape in enumerate(map(slab, spheres.environment))
        ]
        if not len(spheres):
            return
        members = np.zeros(len(spheres), bool)
        members[spheres.edges.ravel()] = True
        if len(spheres.edges):
            points = spheres.center[spheres.edges].astype(np.float32)
            self._edges = scene.add_line_segments("/obstacles/edges", points, _FOAM, thickness=0.003)
            self._handles.append(self._edges)
        fixed = members & (spheres.stiffness >= FIXED_STIFFNESS)
        colours = np.where(fixed[:, None], _FIXED, np.where(members[:, None], _NODE, _FOAM))
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
        self._handles.append(self._spheres)


def _alike(spheres: Spheres, other: Spheres) -> bool:
    """Whether they differ only in their positions."""
    same = (np.array_equal(getattr(spheres, name), getattr(other, name)) for name in ("radius", "edges", "rest"))
    return spheres.environment == other.environment and all(same)
