"""An arm's capsules over the collision geometry that they were fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
import viser

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.capsule_fit import hull
from contact_reach_ros.arm.capsules import shape_name, shape_radii, shape_segments
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.palette import SKY_BLUE, rgb
from contact_reach_ros.drawing.parts import BODY
from contact_reach_ros.viewer.colours import as_bytes

_OPACITY = 0.35
"""Of the capsules, through which the geometry is seen."""


class FitPart(NamedTuple):
    """A mesh in the base frame, the arm being at its home posture."""

    link: str
    mesh: trimesh.Trimesh
    is_capsule: bool


def fit_parts(arm: Arm, geometry: Sequence[Sequence[Array]]) -> list[FitPart]:
    """Collision geometry and capsules.

    `geometry`: of the base and of each link, the balls (N, 4) of each collision shape in the link's frame, m.
    """
    rotations, origins = link_frames(arm, arm.home)
    frames = [(np.eye(3), np.zeros(3)), *zip(rotations, origins, strict=True)]
    parts = []
    for link, (rotation, origin), shapes in zip((arm.base_frame, *arm.link_names), frames, geometry, strict=False):
        for mesh in filter(None, map(hull, shapes)):
            mesh.vertices = mesh.vertices @ rotation.T + origin
            parts.append(FitPart(link, mesh, False))
    starts, ends = (points[0] for points in shape_segments(arm, np.array([arm.home])))
    for shape, (start, end, radius) in enumerate(zip(starts, ends, shape_radii(arm), strict=True)):
        place = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end - start)
        place[:3, 3] = 0.5 * (start + end)
        mesh = trimesh.creation.capsule(float(np.linalg.norm(end - start)), float(radius), transform=place)
        parts.append(FitPart(shape_name(arm, shape), mesh, True))
    return parts


def show_fit(server: viser.ViserServer, arm: Arm, geometry: Sequence[Sequence[Array]]) -> None:
    """Draw them, see `fit_parts`."""
    server.scene.add_grid("/floor", width=2.0, height=2.0, cell_size=0.1, section_size=0.5, plane="xy")
    server.initial_camera.position = (1.2, -1.25, 0.95)
    server.initial_camera.look_at = (0.25, 0.0, 0.35)
    for number, (link, mesh, is_capsule) in enumerate(fit_parts(arm, geometry)):
        server.scene.add_mesh_simple(
            f"/{'capsules' if is_capsule else 'geometry'}/{number} {link}",
            mesh.vertices,
            mesh.faces,
            color=as_bytes(rgb(SKY_BLUE) if is_capsule else BODY),
            opacity=_OPACITY if is_capsule else None,
        )
