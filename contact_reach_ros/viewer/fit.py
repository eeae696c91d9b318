"""An arm's capsules over the collision geometry that they were fitted to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
import viser

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import hull
from contact_reach_ros.arm.capsules import shape_name, shape_radii, shape_segments
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.drawing.palette import SKY_BLUE, rgb
from contact_reach_ros.drawing.parts import BODY
from contact_reach_ros.viewer.handles import as_bytes, capsule_mesh

Meshes = list[tuple[str, trimesh.Trimesh]]

_OPACITY = 0.35
"""Opacity of the capsules, through which the geometry is seen."""


def fit_meshes(arm: Arm, geometry: Sequence[Sequence[Array]]) -> tuple[Meshes, Meshes]:
    """Meshes of the collision geometry and of the capsules, by link, in the base frame, with the arm in home posture.

    `geometry`: of the base and of each link, the balls (N, 4) of each collision shape in the link's frame, m.
    """
    rotations, origins = link_frames(arm, arm.home)
    frames = [(np.eye(3), np.zeros(3)), *zip(rotations, origins, strict=True)]
    shown = []
    for link, (rotation, origin), shapes in zip((arm.base_frame, *arm.link_names), frames, geometry, strict=False):
        for mesh in filter(None, map(hull, shapes)):
            mesh.vertices = mesh.vertices @ rotation.T + origin
            shown.append((link, mesh))
    capsules = []
    starts, ends = (points[0] for points in shape_segments(arm, np.array([arm.home])))
    for shape, (start, end, radius) in enumerate(zip(starts, ends, shape_radii(arm), strict=True)):
        capsules.append((shape_name(arm, shape), capsule_mesh(start, end, radius)))
    return shown, capsules


def show_fit(server: viser.ViserServer, arm: Arm, geometry: Sequence[Sequence[Array]]) -> None:
    """Draw an arm's capsules over its collision geometry, see `fit_meshes`."""
    scene = server.scene
    scene.add_grid("/floor", width=2.0, height=2.0, cell_size=0.1, section_size=0.5, plane="xy")
    server.initial_camera.position = (1.2, -1.25, 0.95)
    server.initial_camera.look_at = (0.25, 0.0, 0.35)
    shown, capsules = fit_meshes(arm, geometry)
    for number, (link, mesh) in enumerate(shown):
        scene.add_mesh_simple(f"/geometry/{number} {link}", mesh.vertices, mesh.faces, color=as_bytes(BODY))
    for number, (link, mesh) in enumerate(capsules):
        colour = as_bytes(rgb(SKY_BLUE))
        scene.add_mesh_simple(f"/capsules/{number} {link}", mesh.vertices, mesh.faces, color=colour, opacity=_OPACITY)
