"""The three-dimensional part of the page: arm, obstacles, plan, contacts and goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
import viser

from contact_reach_ros.arm import Arm, Array, quaternion_from_rotation
from contact_reach_ros.arm.mount import scene_frame
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.palette import BLUE, ORANGE, PURPLE, SKY_BLUE, VERMILION, as_bytes
from contact_reach_ros.viewer.arm import ArmView
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.rigid import slab
from contact_reach_ros.world.spheres import FIXED_STIFFNESS, Spheres

_FOAM, _NODE, _FIXED, _RIGID = (as_bytes(colour) for colour in ("#6BCC94", "#1A8C59", "#383B40", "#99948C"))
_COARSE, _FINE = (trimesh.creation.icosphere(subdivisions=steps) for steps in (1, 3))
_LEAST = 0.2
"""Least force that gets an arrow, N."""
_NEWTON = 0.02
"""Length of an arrow per newton, m."""
_ABOVE = np.array([0.0, 0.0, 0.06])
"""Offset of the labels of estimates, which may be at the same place as true forces, m."""


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
        self._arm = ArmView(server, arm)
        self._obstacles = _ObstacleView(server)
        self._plan = _PlanView(server)
        self._contacts = _ContactView(server, arm, permitted_force)
        scene, frame = server.scene, scene_frame(arm)
        scene.set_up_direction(frame.rotation[:, 2])
        scene.add_grid(
            "/floor",
            width=3.0,
            height=3.0,
            cell_size=0.1,
            section_size=0.5,
            plane="xy",
            shadow_opacity=0.15,
            wxyz=quaternion_from_rotation(frame.rotation),
            position=frame.origin,
        )
        scene.world_axes.visible = False
        server.initial_camera.position = frame.outward(np.array([1.2, -1.25, 0.95]))
        server.initial_camera.look_at = frame.outward(np.array([0.25, 0.0, 0.35]))
        self._goal = scene.add_icosphere("/goal", radius=0.025, color=as_bytes(SKY_BLUE))
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
                self._server.scene.add_line_segments(f"/plan/{name}", segments, as_bytes(colour), thickness=0.006)
            )


class _ObstacleView:
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


class Arrow(NamedTuple):
    """A force on the arm.

    Attributes
    ----------
    point
        (3,) point of application, m.
    force
        (3,), N.
    estimated
        Whether the observer estimated the force from torques; otherwise the simulation measured it.
    """

    point: Array
    force: Array
    estimated: bool


class _ContactView:
    """Arrows of forces, with their magnitudes as labels."""

    def __init__(self, server: viser.ViserServer, arm: Arm, permitted_force: float) -> None:
        self._server = server
        self._arm = arm
        self._permitted = permitted_force
        self._handle: Any = None
        self._labels: list[Any] = []

    def show(self, frame: Frame) -> None:
        """Show the contacts of a moment."""
        found = arrows(self._arm, frame)
        # From outside the arm to the point of application.
        tips = np.array([arrow.point for arrow in found]).reshape(-1, 3)
        tails = tips - _NEWTON * np.array([arrow.force for arrow in found]).reshape(-1, 3)
        self._show_labels(found, tails)
        if self._handle is not None:
            self._handle.visible = bool(found)
        if not found:
            return
        points = np.stack([tails, tips], axis=1).astype(np.float32)
        colours = np.array([self._colour(arrow) for arrow in found], np.uint8)
        if self._handle is None or len(self._handle.points) != len(points):
            self._handle = self._server.scene.add_arrows(
                "/contacts", points, colours, shaft_radius=0.006, head_radius=0.015, head_length=0.03
            )
        else:
            self._handle.points = points
            self._handle.colors = colours

    def _colour(self, arrow: Arrow) -> tuple[int, int, int]:
        if arrow.estimated:
            return as_bytes(PURPLE)
        return as_bytes(VERMILION if np.linalg.norm(arrow.force) > self._permitted else ORANGE)

    def _show_labels(self, found: Sequence[Arrow], tails: Array) -> None:
        while len(self._labels) < len(found):
            self._labels.append(self._server.scene.add_label(f"/labels/{len(self._labels)}", ""))
        for number, label in enumerate(self._labels):
            label.visible = number < len(found)
        for label, arrow, tail in zip(self._labels, found, tails, strict=False):
            label.position = tail + _ABOVE if arrow.estimated else tail
            label.text = f"{np.linalg.norm(arrow.force):.1f} N{' (estimated)' if arrow.estimated else ''}"


def arrows(arm: Arm, frame: Frame) -> list[Arrow]:
    """The contacts of a moment.

    The simulation publishes the magnitude of the force on each link: it is drawn where the link is nearest to an
    obstacle, along their common normal. The observer estimates magnitude, direction and place.
    """
    found = []
    obstacles = frame.obstacles
    if obstacles is not None and len(obstacles):
        for name, size in frame.forces.items():
            if name in arm.contact_links and size >= _LEAST:
                point, normal = _touched(arm, name, frame.q, obstacles)
                found.append(Arrow(point, size * normal, False))
    for status in frame.safety.values():
        contact = status.contact
        if contact is not None and np.linalg.norm(contact.force) >= _LEAST:
            found.append(Arrow(contact.position, contact.force, True))
    return found


def _touched(arm: Arm, link: str, q: Array, spheres: Spheres) -> tuple[Array, Array]:
    """Point of a link's surface nearest to, or deepest in, a sphere, and the unit normal there, pointing inwards."""
    of_link = np.array([arm.link_names[capsule.link - 1] == link for capsule in arm.capsules])
    radii = np.array([capsule.radius for capsule in arm.capsules])[of_link]
    starts, ends = (points[of_link, None] for points in capsule_segments(arm, q))
    axes = ends - starts
    along = np.clip(np.sum((spheres.center - starts) * axes, axis=-1) / np.sum(axes * axes, axis=-1), 0.0, 1.0)
    towards = starts + along[..., None] * axes - spheres.center
    lengths = np.linalg.norm(towards, axis=-1)
    gaps = lengths - spheres.radius - radii[:, None]
    capsule, sphere = np.unravel_index(np.argmin(gaps), gaps.shape)
    normal = towards[capsule, sphere] / max(lengths[capsule, sphere], 1e-9)
    return spheres.center[sphere] + towards[capsule, sphere] - radii[capsule] * normal, normal
