"""Obstacles as visualization markers: what a driver or perception publishes, and what a planner reads of it.

A ball is a SPHERE. A deformable body is a SPHERE_LIST of the nodes that can move, one of those that are fixed, and a
LINE_LIST of the edges that join them, told apart by their namespaces and held together by one id.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Vector3
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from scipy.spatial import cKDTree
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.messages import set_time, to_point, vector
from contact_reach_ros.nodes.serialized import decode
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.scene import Ball, Scene, Wall
from contact_reach_ros.scenes.spheres import FIXED_STIFFNESS, rest_positions
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

OBSTACLES = "obstacles"
FIXED = "fixed"
EDGES = "edges"
REST = "rest"

_GREEN = (0.35, 0.7, 0.35)
_GREY = (0.45, 0.45, 0.45)
_EDGE_WIDTH = 0.004
_MATCH = 1e-4
"""How far the end of an edge may be from its node, m."""
_FIRST_MARK = 1e6
_STAMP_NS = 0x51EC51EC * NANOSECONDS + 0x1A2B3C4D


def obstacle_markers(scene: Scene, positions: Array, stamp_ns: int) -> MarkerArray:
    """The obstacles of a scene at `positions` (K, 3), m, in the order of `rest_positions`."""
    markers = []
    rests = rest_positions(scene)
    for index, ball in enumerate(scene.balls):
        markers.append(_ball_marker(OBSTACLES, index, ball, positions[index], 1.0))
        markers.append(_ball_marker(REST, index, ball, rests[index], 0.15))
    first = len(scene.balls)
    for index, wall in enumerate(scene.walls, start=first):
        nodes = positions[first : first + len(wall.rest)]
        markers += _wall_markers(index, wall, nodes)
        first += len(wall.rest)
    for marker in markers:
        set_time(marker.header.stamp, stamp_ns)
    return MarkerArray(markers=markers)


class ObstacleMarkerWriter:
    """Serialised obstacle messages, fast enough for a 1 kHz loop.

    Of the hundreds of points in a message only the coordinates change, and the stamps: the message is serialised once,
    and each time they are written to where they lie in it.
    """

    def __init__(self, scene: Scene) -> None:
        marks = _FIRST_MARK + np.arange(3 * len(rest_positions(scene)), dtype=float)
        self._buffer = bytearray(serialize_message(obstacle_markers(scene, marks.reshape(-1, 3), _STAMP_NS)))
        self._numbers, self._words = _numbers(self._buffer), _words(self._buffer)
        self._slots = _marked_numbers(self._buffer, marks)
        self._sources = (self._numbers[self._slots] - _FIRST_MARK).astype(int)
        self._stamps = _marked_stamps(self._buffer)

    def write(self, positions: Array, stamp_ns: int) -> bytes:
        """A serialised MarkerArray with the obstacles at `positions` (K, 3), m."""
        self._numbers[self._slots] = positions.ravel()[self._sources]
        self._words[self._stamps] = stamp_ns // NANOSECONDS
        self._words[self._stamps + 1] = stamp_ns % NANOSECONDS
        return bytes(self._buffer)


@dataclass(frozen=True)
class Material:
    """What markers do not tell of obstacles."""

    sphere_stiffness: float
    """Spring that holds a sphere to its place, N/m."""
    sphere_damping: float
    """N s/m."""
    node_stiffness: float
    """Spring that holds a node that can move to its place, N/m."""
    node_damping: float
    """N s/m."""
    edge_stiffness: float
    """N/m."""


class ObstacleMarkerReader:
    """Spheres, and the edges between them, from marker arrays."""

    def __init__(self, material: Material) -> None:
        self._material = material
        self._rests: dict[int, Array] = {}
        self._edges: dict[int, NDArray[np.intp]] = {}
        self._layout: _Layout | None = None

    def read_serialized(self, data: bytes) -> Spheres:
        """The same as `read` for a serialised message.

        Turning hundreds of points into Python objects takes milliseconds. So where they lie in the message is kept, and
        the next one is read without that as long as nothing but points and stamps has changed.

        Raises
        ------
        InputError
            As `read`, or if the bytes are no message.
        """
        if self._layout is None or not self._layout.fits(data):
            message: MarkerArray = decode(data, MarkerArray, topics.OBSTACLES.name)
            spheres = self.read(message)
            shapes = _shapes(message)
            if self._layout is not None and self._layout.describes(data, shapes):
                self._layout.ignore_differences(data)
            else:
                self._layout = _Layout(data, message, shapes)
            return spheres
        return self._spheres(self._layout.read(data))

    def read(self, message: MarkerArray) -> Spheres:
        """The spheres of a message: in the order of their ids, and of each body the nodes that can move first.

        The namespace 'rest' says where springs hold spheres and nodes; else it is where they were seen first.

        Raises
        ------
        InputError
            If a marker is in another frame, of another type than its namespace asks for, has no size or a value that
            is not finite, or an edge ends where no node is; the marker is named.
        """
        return self._spheres(list(zip(_shapes(message), map(_points, message.markers), strict=True)))

    def _spheres(self, shapes: list[tuple[_Shape, Array]]) -> Spheres:
        bodies: dict[int, dict[str, tuple[_Shape, Array]]] = {}
        for shape, points in shapes:
            if not np.isfinite(points).all():
                index = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
                raise InputError(
                    f"obstacles: marker {shape.name}: point {index} is {points[index].tolist()}; expected finite values"
                )
            bodies.setdefault(shape.id, {})[shape.kind] = (shape, points)
        told = {identifier: body[REST][1] for identifier, body in bodies.items() if REST in body}
        rests = self._rests | told
        parts: list[_Part] = []
        for identifier, body in sorted(bodies.items()):
            if body.keys() != {REST}:
                parts.append(self._part(identifier, body, rests, sum(len(part.center) for part in parts)))
        self._rests = rests
        return Spheres(*(np.concatenate(columns) for columns in zip(_EMPTY, *parts, strict=True)))

    def _part(
        self, identifier: int, body: dict[str, tuple[_Shape, Array]], rests: dict[int, Array], first: int
    ) -> _Part:
        """One body, whose first sphere has the number `first`; where it rests is added to `rests` if not known."""
        material = self._material
        (ball, movable), (fixture, fixed) = body.get(OBSTACLES, _NOTHING), body.get(FIXED, _NOTHING)
        rest = rests.setdefault(identifier, movable)
        if len(rest) != len(movable):
            raise InputError(
                f"obstacles: marker {REST}/{identifier} has {len(rest)} points; expected {len(movable)}, one for each "
                "node that can move"
            )
        nodes = np.concatenate([movable, fixed])
        is_ball = ball.type == Marker.SPHERE
        stiffness = material.sphere_stiffness if is_ball else material.node_stiffness
        edges = self._match(identifier, body[EDGES][1], nodes) if EDGES in body else _EMPTY.edges
        return _Part(
            center=nodes,
            rest=np.concatenate([rest, fixed]),
            radius=np.repeat([ball.radius, fixture.radius], [len(movable), len(fixed)]),
            stiffness=np.repeat([stiffness, FIXED_STIFFNESS], [len(movable), len(fixed)]),
            damping=np.full(len(nodes), material.sphere_damping if is_ball else material.node_damping),
            edges=edges + first,
            edge_stiffness=np.full(len(edges), material.edge_stiffness),
        )

    def _match(self, identifier: int, ends: Array, nodes: Array) -> NDArray[np.intp]:
        """Which nodes the edges (2 E, 3) join, (E, 2); looked up only when it is not as it was last time."""
        if len(ends) % 2:
            raise InputError(f"obstacles: marker {EDGES}/{identifier} has {len(ends)} points; expected an even number")
        known = self._edges.get(identifier)
        if known is not None and known.size == len(ends) and known.max(initial=-1) < len(nodes):
            off = np.abs(nodes[known.ravel()] - ends).max(initial=0.0)
            if off <= _MATCH:
                return known
        # An edge without any nodes ends far away from one.
        distances, nearest = cKDTree(nodes if len(nodes) else np.full((1, 3), 1e9)).query(ends)
        if distances.max(initial=0.0) > _MATCH:
            index = int(distances.argmax())
            raise InputError(
                f"obstacles: marker {EDGES}/{identifier}: edge {index // 2} ends at "
                f"{np.round(ends[index], 4).tolist()} m, where no node is; expected a point of "
                f"{OBSTACLES}/{identifier} or {FIXED}/{identifier}"
            )
        self._edges[identifier] = nearest.reshape(-1, 2)
        return self._edges[identifier]


class _Part(NamedTuple):
    """The fields of `Spheres` for one body."""

    center: Array
    rest: Array
    radius: Array
    stiffness: Array
    damping: Array
    edges: NDArray[np.intp]
    edge_stiffness: Array


_EMPTY = _Part(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 2), np.intp), np.zeros(0)
)

_TYPES = {
    OBSTACLES: {Marker.SPHERE: "SPHERE", Marker.SPHERE_LIST: "SPHERE_LIST"},
    REST: {Marker.SPHERE: "SPHERE", Marker.SPHERE_LIST: "SPHERE_LIST"},
    FIXED: {Marker.SPHERE_LIST: "SPHERE_LIST"},
    EDGES: {Marker.LINE_LIST: "LINE_LIST"},
}


class _Shape(NamedTuple):
    """What a marker is, without its points."""

    name: str
    kind: str
    id: int
    type: int
    radius: float
    points: int
    """Their number."""


_NOTHING = (_Shape("", OBSTACLES, 0, Marker.SPHERE_LIST, 0.0, 0), np.zeros((0, 3)))


class _Layout:
    """Where the points lie in a serialised message, and which of its bytes have to stay as they are."""

    def __init__(self, data: bytes, message: MarkerArray, shapes: list[_Shape]) -> None:
        self._data = np.frombuffer(data, np.uint8)
        self._shapes = shapes
        self._ends = np.cumsum([shape.points for shape in shapes])
        count = int(self._ends[-1]) if shapes else 0
        marks = _FIRST_MARK + np.arange(3 * count, dtype=float)
        points = iter(marks.reshape(-1, 3).tolist())
        for marker in message.markers:
            if marker.type == Marker.SPHERE:
                marker.pose.position = to_point(next(points))
            else:
                marker.points = [to_point(next(points)) for _ in marker.points]
            set_time(marker.header.stamp, _STAMP_NS)
        marked = bytearray(serialize_message(message))
        self._slots = _marked_numbers(marked, marks)
        is_same = np.ones(len(marked), bool)
        is_same[4 + (8 * self._slots[:, None] + np.arange(8))] = False
        is_same[4 + (4 * _marked_stamps(marked)[:, None] + np.arange(8))] = False
        self._same = np.flatnonzero(is_same)
        # A message in another byte order, for one, is always read in full.
        self._usable = data[:2] == bytes(marked[:2]) and len(data) == len(marked) and len(self._slots) == 3 * count

    def fits(self, data: bytes) -> bool:
        """Whether nothing has changed but points and stamps."""
        if not self._usable or len(data) != len(self._data):
            return False
        return bool((np.frombuffer(data, np.uint8)[self._same] == self._data[self._same]).all())

    def describes(self, data: bytes, shapes: list[_Shape]) -> bool:
        """Whether a message with these markers, which does not fit, is laid out alike."""
        return self._usable and len(data) == len(self._data) and shapes == self._shapes

    def ignore_differences(self, data: bytes) -> None:
        """Where a message that says the same has other bytes, they mean nothing: gaps between fields, colours."""
        self._same = self._same[np.frombuffer(data, np.uint8)[self._same] == self._data[self._same]]

    def read(self, data: bytes) -> list[tuple[_Shape, Array]]:
        """The points of a message that fits, by marker."""
        points = np.split(_numbers(data)[self._slots].reshape(-1, 3), self._ends[:-1])
        return list(zip(self._shapes, points, strict=False))


def _marked_numbers(data: bytearray, marks: Array) -> NDArray[np.intp]:
    """Which of the 8-byte numbers of a serialised message are among `marks`."""
    return np.flatnonzero(np.isin(_numbers(data), marks))


def _marked_stamps(data: bytearray) -> NDArray[np.intp]:
    """Which of the 4-byte words of a serialised message begin a stamp of `_STAMP_NS`."""
    words = _words(data)
    seconds, nanoseconds = divmod(_STAMP_NS, NANOSECONDS)
    return np.flatnonzero((words[:-1] == seconds) & (words[1:] == nanoseconds))


def _numbers(data: bytes | bytearray) -> Array:
    # CDR aligns numbers to their size, counted from behind its header of four bytes.
    return np.frombuffer(data, "<f8", (len(data) - 4) // 8, 4)


def _words(data: bytes | bytearray) -> NDArray[np.uint32]:
    return np.frombuffer(data, "<u4", (len(data) - 4) // 4, 4)


def _shapes(message: MarkerArray) -> list[_Shape]:
    """The markers of a message; raises `InputError` if one is not as its namespace asks for, or comes twice."""
    shapes: list[_Shape] = []
    for marker in message.markers:
        # Spheres may be in any other namespace too, as perception calls them.
        kind = marker.ns if marker.ns in (REST, FIXED, EDGES) else OBSTACLES
        name = f"{marker.ns}/{marker.id}"
        _check(marker, kind, name)
        if any((shape.kind, shape.id) == (kind, marker.id) for shape in shapes):
            raise InputError(f"obstacles: marker {name} comes twice; expected each namespace and id once")
        count = 1 if marker.type == Marker.SPHERE else len(marker.points)
        shapes.append(_Shape(name, kind, marker.id, marker.type, 0.5 * marker.scale.x, count))
    return shapes


def _check(marker: Marker, kind: str, name: str) -> None:
    if marker.header.frame_id != iiwa14.BASE_NAME:
        raise InputError(f"obstacles: header.frame_id is '{marker.header.frame_id}'; expected '{iiwa14.BASE_NAME}'")
    types = _TYPES[kind]
    if marker.action != Marker.ADD or marker.type not in types:
        raise InputError(
            f"obstacles: marker {name} has type {marker.type} and action {marker.action}; expected "
            f"{' or '.join(types.values())}, to ADD"
        )
    if kind in (OBSTACLES, FIXED) and not 0.0 < marker.scale.x < np.inf:
        raise InputError(f"obstacles: marker {name}: scale.x = {marker.scale.x}; expected a diameter in m")
    pose = marker.pose
    if marker.type != Marker.SPHERE and (vector(pose.position).any() or vector(pose.orientation).any()):
        raise InputError(f"obstacles: marker {name} has a pose; expected none, and its points in the frame")


def _points(marker: Marker) -> Array:
    """Centre of a sphere or points of a list, (N, 3), m."""
    points = [marker.pose.position] if marker.type == Marker.SPHERE else marker.points
    return np.array([(point.x, point.y, point.z) for point in points]).reshape(-1, 3)


def _ball_marker(namespace: str, index: int, ball: Ball, position: Array, opacity: float) -> Marker:
    marker = _marker(namespace, index, Marker.SPHERE, 2.0 * ball.settings.radius, (*_GREEN, opacity))
    marker.pose.position = to_point(position.tolist())
    return marker


def _wall_markers(index: int, wall: Wall, nodes: Array) -> list[Marker]:
    diameter = 2.0 * wall.settings.node_radius
    free, ends = ~wall.fixed, wall.edges.ravel()
    table = (
        (OBSTACLES, Marker.SPHERE_LIST, diameter, (*_GREEN, 1.0), nodes[free]),
        (FIXED, Marker.SPHERE_LIST, diameter, (*_GREY, 1.0), nodes[wall.fixed]),
        (EDGES, Marker.LINE_LIST, _EDGE_WIDTH, (*_GREEN, 0.6), nodes[ends]),
        (REST, Marker.SPHERE_LIST, diameter, (*_GREEN, 0.1), wall.rest[free]),
    )
    markers = []
    for namespace, kind, scale, color, points in table:
        marker = _marker(namespace, index, kind, scale, color)
        marker.points = [to_point(point) for point in points.tolist()]
        markers.append(marker)
    return markers


def _marker(namespace: str, index: int, kind: int, scale: float, color: Sequence[float]) -> Marker:
    red, green, blue, opacity = color
    marker = Marker(
        ns=namespace,
        id=index,
        type=kind,
        scale=Vector3(x=scale, y=scale, z=scale),
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
    )
    marker.header.frame_id = iiwa14.BASE_NAME
    marker.pose.orientation.w = 1.0
    return marker
