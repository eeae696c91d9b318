"""The three-dimensional part of the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from contact_reach_ros.palette import BLUE, GREEN, ORANGE, PURPLE, SKY_BLUE, VERMILION, rgb
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.rendering.parts import DARK, FOAM, NODE, link_shapes
from contact_reach_ros.rendering.shapes import Cylinder, Shape, as_mesh
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.scenes.spheres import FIXED_STIFFNESS
from contact_reach_ros.viewer.colours import as_bytes, share_colour
from contact_reach_ros.viewer.contacts import Arrow, arrows
from contact_reach_ros.viewer.foam import Surface, bodies, surface
from contact_reach_ros.viewer.frame import Frame, PlanPicture

Array = NDArray[np.float64]

_STILL = 1e-4
"""Change of a joint, rad, that nobody would see."""
_BASE_PARTS = 2
"""Shapes of the base that turn with the first link, as far as one sees: they show its torque."""
_NEWTON = 0.02
"""Length of an arrow for each newton, m."""
_LABEL_SPACE = 0.12
"""Distance at which two texts do not cover each other, m."""
_GHOST_OPACITY = 0.22
_UNIT_CYLINDER = as_mesh(Cylinder(np.array([0.0, 0.0, -0.5]), np.array([0.0, 0.0, 0.5]), 1.0, (1.0, 1.0, 1.0, 1.0)))
_COARSE, _FINE = (trimesh.creation.icosphere(subdivisions=steps) for steps in (1, 3))


class ScenePart:
    """Arm, obstacles, plan, contacts and goal, kept as a frame says.

    Parameters
    ----------
    server
        Of the page.
    thresholds
        (7,) external torque at which a link has the colour of a stop, Nm.
    permitted_force
        N; above it an arrow has the colour of a stop.
    """

    def __init__(self, server: viser.ViserServer, thresholds: Sequence[float], permitted_force: float) -> None:
        self._server = server
        self._thresholds = np.array(thresholds)
        self._arm = _ArmPart(server)
        self._obstacles = _ObstaclePart(server)
        self._plan = _PlanPart(server)
        self._contacts = _ContactPart(server, permitted_force)
        scene = server.scene
        scene.add_grid(
            "/floor", width=3.0, height=3.0, cell_size=0.1, section_size=0.5, plane="xy", shadow_opacity=0.15
        )
        scene.world_axes.visible = False
        server.initial_camera.position = (1.2, -1.25, 0.95)
        server.initial_camera.look_at = (0.25, 0.0, 0.35)
        self._goal = _ball(server, "/goal", 0.025, rgb(SKY_BLUE))
        self._goal.visible = False

    def show(self, frame: Frame) -> None:
        """Show a moment; what is not known is hidden."""
        with self._server.atomic():
            self._arm.move(frame.q)
            torque = np.zeros(len(self._thresholds)) if frame.external_torque is None else frame.external_torque
            self._arm.colour(np.abs(np.nan_to_num(torque)) / self._thresholds)
            self._obstacles.show(frame.obstacles)
            self._plan.show(frame.plan)
            self._contacts.show(arrows(frame))
            _set(self._goal, "visible", frame.goal is not None)
            if frame.goal is not None:
                _set(self._goal, "position", tuple(frame.goal.tolist()))


class Wish:
    """The goal that a user drags, before it is sent.

    Attributes
    ----------
    position
        (3,), m.
    """

    def __init__(self, server: viser.ViserServer, moved: Callable[[Array], None]) -> None:
        """`moved` is called with where a user has put it."""
        self.position = np.zeros(3)
        reach = iiwa14.MAX_REACH + 0.15
        limits = ((-reach, reach), (-reach, reach), (0.0, reach + iiwa14.SHOULDER_POSITION[2]))
        self._handle = server.scene.add_transform_controls(
            "/wish",
            scale=0.18,
            disable_rotations=True,
            disable_sliders=True,
            translation_limits=limits,
            depth_test=False,
        )
        self._ball = _ball(server, "/wish/ball", 0.02, rgb(GREEN))

        @self._handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self.position = np.array(event.target.position, float)
            moved(self.position)

    def put(self, position: Array) -> None:
        """Move it to a position (3,), m."""
        self.position = np.array(position, float)
        self._handle.position = self.position

    def mark(self, reachable: bool) -> None:
        """Show whether the arm could get there."""
        _set(self._ball, "color", as_bytes(rgb(GREEN if reachable else VERMILION)))

    def show(self, visible: bool) -> None:
        """Show or hide it."""
        _set(self._handle, "visible", visible)


class _ArmPart:
    def __init__(self, server: viser.ViserServer) -> None:
        self._frames: list[Any] = []
        self._tinted: list[list[Any]] = [[] for _ in iiwa14.JOINTS]
        self._q: Array | None = None
        self._colours: list[tuple[int, int, int]] = [(0, 0, 0)] * iiwa14.N_JOINTS
        for link, shapes in enumerate(link_shapes()):
            self._frames.append(server.scene.add_frame(f"/arm/{link}", show_axes=False))
            for number, shape in enumerate(shapes):
                handle = _mesh(server, f"/arm/{link}/{number}", shape)
                # Covers of joints and the dark parts keep their colour.
                if (link == 0 and number < _BASE_PARTS) or (link > 0 and number == 0):
                    self._tinted[max(link - 1, 0)].append(handle)

    def move(self, q: Array) -> None:
        if self._q is not None and np.abs(q - self._q).max() < _STILL:
            return
        self._q = q
        for frame, rotation, origin in zip(self._frames[1:], *link_frames(q), strict=False):
            frame.wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
            frame.position = origin

    def colour(self, shares: Array) -> None:
        for joint, share in enumerate(shares.tolist()):
            colour = share_colour(share)
            if colour != self._colours[joint]:
                self._colours[joint] = colour
                for handle in self._tinted[joint]:
                    handle.color = colour


class _Body(NamedTuple):
    indices: NDArray[np.intp]
    surface: Surface | None
    handle: Any


class _ObstaclePart:
    """Balls, the nodes of deformable bodies, and their surfaces."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: Spheres | None = None
        self._spheres: Any = None
        self._bodies: list[_Body] = []

    def show(self, spheres: Spheres | None) -> None:
        shown = self._shown
        if spheres is shown:
            return
        if shown is None or spheres is None or not _alike(spheres, shown):
            self._build(spheres)
        elif np.abs(spheres.center - shown.center).max(initial=0.0) < _STILL:
            return
        self._shown = spheres
        if spheres is None or not len(spheres):
            return
        self._spheres.batched_positions = spheres.center.astype(np.float32)
        for body in self._bodies:
            if body.surface is not None:
                vertices = body.surface.vertices(spheres.center[body.indices], float(spheres.radius[body.indices[0]]))
                body.handle.vertices = vertices.astype(np.float32)

    def _build(self, spheres: Spheres | None) -> None:
        for handle in (self._spheres, *(body.handle for body in self._bodies)):
            if handle is not None:
                handle.remove()
        self._spheres, self._bodies = None, []
        if spheres is None or not len(spheres):
            return
        scene = self._server.scene
        members = np.zeros(len(spheres), bool)
        for number, indices in enumerate(bodies(spheres)):
            members[indices] = True
            renumbered = np.full(len(spheres), -1)
            renumbered[indices] = np.arange(len(indices))
            edges = renumbered[spheres.edges]
            outer = surface(spheres.rest[indices], edges[(edges >= 0).all(axis=1)])
            handle = None
            if outer is not None:
                vertices = outer.vertices(spheres.center[indices], float(spheres.radius[indices[0]]))
                handle = scene.add_mesh_simple(
                    f"/obstacles/surface_{number}",
                    vertices,
                    outer.faces,
                    color=as_bytes(FOAM),
                    opacity=0.5,
                    flat_shading=True,
                    side="double",
                )
            self._bodies.append(_Body(indices, outer, handle))
        fixed = members & (spheres.stiffness >= FIXED_STIFFNESS)
        colours = np.where(fixed[:, None], as_bytes(DARK), np.where(members[:, None], as_bytes(NODE), as_bytes(FOAM)))
        # Half as large as they are, the nodes of a body let one see how it deforms.
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


class _PlanPart:
    """Paths of flange and elbow, and the arm at the end of the plan."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: PlanPicture | None = None
        self._lines: dict[str, Any] = {}
        self._ghost: Any = None

    def show(self, plan: PlanPicture | None) -> None:
        if plan is self._shown:
            return
        self._shown = plan
        for name, colour, points in (
            ("flange", BLUE, None if plan is None else plan.flange),
            ("elbow", ORANGE, None if plan is None else plan.elbow),
        ):
            self._line(name, colour, points)
        if plan is None or not len(plan.ghost_radii):
            if self._ghost is not None:
                _set(self._ghost, "visible", False)
            return
        axes = plan.ghost_ends - plan.ghost_starts
        lengths = np.linalg.norm(axes, axis=1)
        turns = np.array([_turn_to(axis / max(length, 1e-9)) for axis, length in zip(axes, lengths, strict=True)])
        radii = plan.ghost_radii
        scales = np.stack([radii, radii, np.maximum(lengths, 1e-3)], axis=1).astype(np.float32)
        middles = 0.5 * (plan.ghost_starts + plan.ghost_ends)
        if self._ghost is None or len(self._ghost.batched_positions) != len(radii):
            self._ghost = self._server.scene.add_batched_meshes_simple(
                "/plan/ghost",
                _UNIT_CYLINDER.vertices,
                _UNIT_CYLINDER.faces,
                batched_wxyzs=turns,
                batched_positions=middles,
                batched_scales=scales,
                batched_colors=as_bytes(rgb(SKY_BLUE)),
                opacity=_GHOST_OPACITY,
                cast_shadow=False,
                receive_shadow=False,
                lod="off",
            )
        self._ghost.batched_wxyzs = turns.astype(np.float32)
        self._ghost.batched_positions = middles.astype(np.float32)
        self._ghost.batched_scales = scales
        _set(self._ghost, "visible", True)

    def _line(self, name: str, colour: str, points: Array | None) -> None:
        line = self._lines.get(name)
        if points is None or len(points) < 2:
            if line is not None:
                _set(line, "visible", False)
            return
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        if line is None:
            self._lines[name] = self._server.scene.add_line_segments(
                f"/plan/{name}", segments, as_bytes(rgb(colour)), thickness=0.006
            )
            return
        line.points = segments
        _set(line, "visible", True)


class _ContactPart:
    """Arrows of forces, and their sizes as text."""

    def __init__(self, server: viser.ViserServer, permitted_force: float) -> None:
        self._server = server
        self._permitted = permitted_force
        self._handle: Any = None
        self._labels: list[Any] = []

    def show(self, found: list[Arrow]) -> None:
        if not found:
            if self._handle is not None:
                _set(self._handle, "visible", False)
            self._show_labels([])
            return
        # Drawn up to where it pushes, from outside of the arm.
        tips = np.array([arrow.point for arrow in found])
        tails = tips - _NEWTON * np.array([arrow.force for arrow in found])
        points = np.stack([tails, tips], axis=1).astype(np.float32)
        colours = np.array([self._colour(arrow) for arrow in found], np.uint8)
        if self._handle is None or len(self._handle.points) != len(points):
            self._handle = self._server.scene.add_arrows(
                "/contacts", points, colours, shaft_radius=0.006, head_radius=0.015, head_length=0.03
            )
        else:
            self._handle.points = points
            self._handle.colors = colours
            _set(self._handle, "visible", True)
        self._show_labels(_labels(tails, found))

    def _colour(self, arrow: Arrow) -> tuple[int, int, int]:
        if arrow.estimated:
            return as_bytes(rgb(PURPLE))
        return as_bytes(rgb(VERMILION if np.linalg.norm(arrow.force) > self._permitted else ORANGE))

    def _show_labels(self, texts: list[tuple[Array, str]]) -> None:
        while len(self._labels) < len(texts):
            self._labels.append(self._server.scene.add_label(f"/labels/{len(self._labels)}", ""))
        for number, label in enumerate(self._labels):
            _set(label, "visible", number < len(texts))
            if number < len(texts):
                label.position = texts[number][0]
                _set(label, "text", texts[number][1])


def _labels(places: Array, found: list[Arrow]) -> list[tuple[Array, str]]:
    """Places and texts of forces; what would stand on top of each other is one text."""
    labels: list[tuple[Array, str]] = []
    for place, arrow in zip(places, found, strict=True):
        text = f"{np.linalg.norm(arrow.force):.1f} N{' (estimated)' if arrow.estimated else ''}"
        near = (row for row, (other, _) in enumerate(labels) if np.linalg.norm(other - place) < _LABEL_SPACE)
        row = next(near, None)
        if row is None:
            labels.append((place, text))
        else:
            labels[row] = (labels[row][0], f"{labels[row][1]}, {text}")
    return labels


def _alike(spheres: Spheres, other: Spheres) -> bool:
    """Whether they differ in their positions only."""
    return all(np.array_equal(getattr(spheres, name), getattr(other, name)) for name in ("radius", "edges", "rest"))


def _turn_to(axis: Array) -> Array:
    """Quaternion (w, x, y, z) that turns z to a unit vector."""
    w = 1.0 + axis[2]
    if w < 1e-6:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([w, -axis[1], axis[0], 0.0])
    return quaternion / np.linalg.norm(quaternion)


def _mesh(server: viser.ViserServer, name: str, shape: Shape) -> Any:
    mesh = as_mesh(shape)
    return server.scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=as_bytes(shape.colour))


def _ball(server: viser.ViserServer, name: str, radius: float, colour: tuple[float, float, float]) -> Any:
    return server.scene.add_icosphere(name, radius=radius, color=as_bytes(colour))


def _set(handle: Any, name: str, value: Any) -> None:
    """Set a property if it changes: each assignment is sent to all browsers."""
    present = getattr(handle, name)
    same = np.array_equal(present, value) if isinstance(present, np.ndarray) else present == value
    if not same:
        setattr(handle, name, value)
