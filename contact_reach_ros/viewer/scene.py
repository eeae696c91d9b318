"""The three-dimensional part of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.drawing.palette import BLUE, ORANGE, SKY_BLUE, VERMILION, as_bytes, rgb
from contact_reach_ros.drawing.parts import BODY, link_shapes
from contact_reach_ros.drawing.shapes import Capsule, Cylinder, Solid, Sphere
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.viewer.contacts import ContactView
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.obstacles import ObstacleView

_BASE_PARTS = 2
"""Number of base shapes that show the first joint's torque if its link has no shape of its own."""
_AROUND = 36
"""Number of corners of a circle."""
_SHARES = (0.0, 0.5, 1.0)
_RAMP = np.array([BODY, rgb(ORANGE), rgb(VERMILION)])


class SceneView:
    """Arm, obstacles, plan, contacts and goal of a frame.

    Parameters
    ----------
    server
        Server of the page.
    arm
        Arm to show.
    thresholds
        (n,) external torque at which a link has the colour of a stop, Nm.
    permitted_force
        Force above which an arrow has the colour of a stop, N.
    """

    def __init__(
        self, server: viser.ViserServer, arm: Arm, thresholds: Sequence[float], permitted_force: float
    ) -> None:
        self._server = server
        self._thresholds = np.array(thresholds)
        self._arm = _ArmView(server, arm)
        self._obstacles = ObstacleView(server)
        self._plan = _PlanView(server)
        self._contacts = ContactView(server, arm, permitted_force)
        scene = server.scene
        scene.add_grid(
            "/floor", width=3.0, height=3.0, cell_size=0.1, section_size=0.5, plane="xy", shadow_opacity=0.15
        )
        scene.world_axes.visible = False
        server.initial_camera.position = (1.2, -1.25, 0.95)
        server.initial_camera.look_at = (0.25, 0.0, 0.35)
        self._goal = scene.add_icosphere("/goal", radius=0.025, color=as_bytes(rgb(SKY_BLUE)))
        self._goal.visible = False

    def show(self, frame: Frame) -> None:
        """Show a moment; hide what is unknown."""
        with self._server.atomic():
            self._arm.move(frame.q)
            torque = np.zeros(len(self._thresholds)) if frame.external_torque is None else frame.external_torque
            self._arm.colour(np.abs(np.nan_to_num(torque)) / self._thresholds)
            self._obstacles.show(frame.obstacles)
            self._plan.show(frame.plan)
            self._contacts.show(frame)
            self._goal.visible = frame.goal is not None
            if frame.goal is not None:
                self._goal.position = frame.goal


class _ArmView:
    """The arm, each link in the colour of its joint's external torque."""

    def __init__(self, server: viser.ViserServer, arm: Arm) -> None:
        self._model = arm
        self._frames: list[Any] = []
        self._tinted: list[list[Any]] = [[] for _ in arm.joints]
        parts = link_shapes(arm)
        for link, shapes in enumerate(parts):
            self._frames.append(server.scene.add_frame(f"/arm/{link}", show_axes=False))
            for number, shape in enumerate(shapes):
                handle = _mesh(server, f"/arm/{link}/{number}", shape)
                # The base's plate and the covers of joints keep their colour.
                if link == 0 and number < _BASE_PARTS and not parts[1]:
                    self._tinted[0].append(handle)
                elif isinstance(shape, Capsule):
                    self._tinted[link - 1].append(handle)

    def move(self, q: Array) -> None:
        """Show the links at joint angles `q` (n,), rad."""
        for frame, rotation, origin in zip(self._frames[1:], *link_frames(self._model, q), strict=False):
            frame.wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
            frame.position = origin

    def colour(self, shares: Array) -> None:
        """Colour the links by shares (n,) of the torque that stops the arm."""
        for share, handles in zip(shares.tolist(), self._tinted, strict=True):
            for handle in handles:
                handle.color = share_colour(share)


class _PlanView:
    """Paths of flange and elbow."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: PlanPicture | None = None
        self._lines: list[Any] = []

    def show(self, plan: PlanPicture | None) -> None:
        """Show a plan; None hides it."""
        if plan is self._shown:
            return
        self._shown = plan
        for line in self._lines:
            line.remove()
        self._lines = []
        if plan is not None:
            self._add("flange", BLUE, plan.flange)
            self._add("elbow", ORANGE, plan.elbow)

    def _add(self, name: str, colour: str, points: Array) -> None:
        if len(points) > 1:
            segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            self._lines.append(
                self._server.scene.add_line_segments(f"/plan/{name}", segments, as_bytes(rgb(colour)), thickness=0.006)
            )


def share_colour(share: float) -> tuple[int, int, int]:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond."""
    return as_bytes(tuple(float(np.interp(share, _SHARES, channel)) for channel in _RAMP.T))


def share_gradient() -> str:
    """The colours of `share_colour` as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"


def _mesh(server: viser.ViserServer, name: str, shape: Solid) -> Any:
    if isinstance(shape, Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=shape.radius)
        mesh.apply_translation(shape.center)
    elif isinstance(shape, Cylinder):
        ends = np.stack([shape.start, shape.end])
        # Split at its edges; otherwise viser would shade the flat ends and the side as one round surface.
        mesh = trimesh.creation.cylinder(shape.radius, segment=ends, sections=_AROUND).smooth_shaded
    else:
        place = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], shape.end - shape.start)
        place[:3, 3] = 0.5 * (shape.start + shape.end)
        length = float(np.linalg.norm(shape.end - shape.start))
        mesh = trimesh.creation.capsule(length, shape.radius, count=[_AROUND, _AROUND // 2], transform=place)
    return server.scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=as_bytes(shape.colour))
