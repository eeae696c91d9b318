"""Obstacles read from visualization markers, of any object with the fields of the messages.

A ball is a SPHERE. A deformable body is a SPHERE_LIST of the nodes that can move, one of those that are fixed, and a
LINE_LIST of the edges that join them, told apart by their namespaces and held together by one id. Its material is the
one that the planner assumes, unless the text of the marker of what can move gives it, see `material_text`. A rigid body
is a CUBE, in namespace 'plane' with everything behind the face to which its z axis points.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import FrameError, InputError
from contact_reach_ros.messages.obstacle_material import BodyMaterial, material_of
from contact_reach_ros.messages.values import nanoseconds, quaternion, vector
from contact_reach_ros.world.rigid import Block, Environment, Plane, RigidBody
from contact_reach_ros.world.spheres import FIXED_STIFFNESS, Spheres

OBSTACLES = "obstacles"
FIXED = "fixed"
EDGES = "edges"
REST = "rest"
PLANE = "plane"
BLOCK = "block"

CUBE, SPHERE, LINE_LIST, SPHERE_LIST = 1, 2, 5, 7
"""Types of a visualization_msgs/msg/Marker."""
_ADD = 0

_MATCH = 1e-4
"""How far the end of an edge may be from its node, m."""


@dataclass(frozen=True)
class AssumedMaterial:
    """Properties of obstacles whose markers do not carry them."""

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

    @classmethod
    def of(cls, settings: Any) -> AssumedMaterial:
        """The material assumed by the planner's settings, by the names of its fields."""
        return cls(**{field.name: getattr(settings, field.name) for field in fields(cls)})


class ObstacleMarkerReader:
    """Spheres, and the edges between them, from marker arrays.

    Parameters
    ----------
    frame
        In which markers must be: the arm's base frame.
    material
        Of the obstacles.

    Attributes
    ----------
    stamp_ns
        When the obstacles that were read last had been seen: the oldest stamp of their markers, ns; None where none has
        one, as in an empty message.
    """

    def __init__(self, frame: str, material: AssumedMaterial) -> None:
        self.stamp_ns: int | None = None
        self._frame = frame
        self._material = material
        self._rests: dict[int, Array] = {}
        self._edges: dict[int, NDArray[np.intp]] = {}

    def read(self, message: Any) -> Spheres:
        """The spheres of a message: in the order of their ids, and of each body the nodes that can move first.

        Springs hold spheres and nodes where the namespace 'rest' has them, or else where they were seen first. Raises
        `InputError` if a marker is in another frame, of another type than its namespace needs, has no size or a value
        that is not finite, or an edge ends where no node is; the marker is named.
        """
        points = map(points_of, soft_markers(message))
        rigid = environment_of(message, self._frame)
        spheres = self.spheres(list(zip(shapes_of(message, self._frame), points, strict=True)), rigid)
        self.stamp_ns = oldest([nanoseconds(marker.header.stamp) for marker in message.markers])
        return spheres

    def spheres(self, shapes: list[tuple[Shape, Array]], environment: Environment) -> Spheres:
        """The spheres of markers and their points (N, 3), m, and rigid bodies; raises as `read` does."""
        bodies: dict[int, dict[str, tuple[Shape, Array]]] = {}
        for shape, points in shapes:
            if not np.isfinite(points).all():
                index = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
                raise InputError(
                    f"obstacles: marker {shape.name}: point {index} is {points[index].tolist()}; expected finite values"
                )
            bodies.setdefault(shape.id, {})[shape.kind] = (shape, points)
        given = {identifier: body[REST][1] for identifier, body in bodies.items() if REST in body}
        rests = self._rests | given
        parts: list[_Part] = []
        count = 0
        for identifier, body in sorted(bodies.items()):
            if body.keys() != {REST}:
                parts.append(self._part(identifier, body, rests, count))
                count += len(parts[-1].center)
        self._rests = rests
        whole = _Part(*(np.concatenate(columns) for columns in zip(_EMPTY, *parts, strict=True)))
        return Spheres(**whole._asdict(), environment=environment)

    def _part(
        self, identifier: int, body: dict[str, tuple[Shape, Array]], rests: dict[int, Array], first: int
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
        stiffness, damping, edge_stiffness = ball.material or (
            (material.sphere_stiffness, material.sphere_damping, material.edge_stiffness)
            if ball.type == SPHERE
            else (material.node_stiffness, material.node_damping, material.edge_stiffness)
        )
        edges = self._match(identifier, body[EDGES][1], nodes) if EDGES in body else _EMPTY.edges
        return _Part(
            center=nodes,
            rest=np.concatenate([rest, fixed]),
            radius=np.repeat([ball.radius, fixture.radius], [len(movable), len(fixed)]),
            stiffness=np.repeat([stiffness, FIXED_STIFFNESS], [len(movable), len(fixed)]),
            damping=np.full(len(nodes), damping),
            edges=edges + first,
            edge_stiffness=np.full(len(edges), edge_stiffness),
        )

    def _match(self, identifier: int, ends: Array, nodes: Array) -> NDArray[np.intp]:
        """Which nodes the edges (2 E, 3) join, (E, 2); looked up only when it has changed."""
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
    OBSTACLES: {SPHERE: "SPHERE", SPHERE_LIST: "SPHERE_LIST"},
    REST: {SPHERE: "SPHERE", SPHERE_LIST: "SPHERE_LIST"},
    FIXED: {SPHERE_LIST: "SPHERE_LIST"},
    EDGES: {LINE_LIST: "LINE_LIST"},
}


class Shape(NamedTuple):
    """A marker without its points."""

    name: str
    kind: str
    id: int
    type: int
    radius: float
    points: int
    """Their number."""
    material: BodyMaterial | None = None
    """What the marker says of it."""


_NOTHING = (Shape("", OBSTACLES, 0, SPHERE_LIST, 0.0, 0), np.zeros((0, 3)))


def shapes_of(message: Any, frame: str) -> list[Shape]:
    """The spheres and edges of a message; raises `InputError` if one does not fit its namespace, or comes twice."""
    shapes: list[Shape] = []
    seen: set[tuple[str, int]] = set()
    for marker in soft_markers(message):
        # Spheres may be in any other namespace too, as perception calls them.
        kind = marker.ns if marker.ns in (REST, FIXED, EDGES) else OBSTACLES
        name = f"{marker.ns}/{marker.id}"
        _check(marker, frame, kind, name)
        if (kind, marker.id) in seen:
            raise InputError(f"obstacles: marker {name} comes twice; expected each namespace and id once")
        seen.add((kind, marker.id))
        count = 1 if marker.type == SPHERE else len(marker.points)
        material = material_of(marker, name) if kind == OBSTACLES else None
        shapes.append(Shape(name, kind, marker.id, marker.type, 0.5 * marker.scale.x, count, material))
    return shapes


def soft_markers(message: Any) -> list[Any]:
    """All markers but those of rigid bodies."""
    return [marker for marker in message.markers if marker.type != CUBE]


def environment_of(message: Any, frame: str) -> Environment:
    """The rigid bodies of a message, named by their markers' text; raises `InputError` if one has no pose or size."""
    bodies: dict[tuple[str, int], RigidBody] = {}
    for marker in message.markers:
        if marker.type != CUBE:
            continue
        name = f"{marker.ns}/{marker.id}"
        _check_frame(marker, frame)
        if marker.action != _ADD:
            raise InputError(f"obstacles: marker {name} has action {marker.action}; expected CUBE, to ADD")
        if (marker.ns, marker.id) in bodies:
            raise InputError(f"obstacles: marker {name} comes twice; expected each namespace and id once")
        center, size, turn = vector(marker.pose.position), vector(marker.scale), quaternion(marker.pose.orientation)
        try:
            body = Block(marker.text or name, center, size, turn)
        except InputError as error:
            raise InputError(f"obstacles: marker {name}: {error}") from error
        if marker.ns == PLANE:
            up = body.axes[:, 2]
            bodies[marker.ns, marker.id] = Plane(body.name, center + 0.5 * size[2] * up, up)
        else:
            bodies[marker.ns, marker.id] = body
    return tuple(bodies.values())


def _check_frame(marker: Any, frame: str) -> None:
    if marker.header.frame_id != frame:
        raise FrameError(f"obstacles: header.frame_id is '{marker.header.frame_id}'; expected '{frame}'")


def _check(marker: Any, frame: str, kind: str, name: str) -> None:
    _check_frame(marker, frame)
    types = _TYPES[kind]
    if marker.action != _ADD or marker.type not in types:
        raise InputError(
            f"obstacles: marker {name} has type {marker.type} and action {marker.action}; expected "
            f"{' or '.join(types.values())}, to ADD"
        )
    if kind in (OBSTACLES, FIXED) and not 0.0 < marker.scale.x < np.inf:
        raise InputError(f"obstacles: marker {name}: scale.x = {marker.scale.x}; expected a diameter in m")
    pose = marker.pose
    if marker.type != SPHERE and (vector(pose.position).any() or vector(pose.orientation).any()):
        raise InputError(f"obstacles: marker {name} has a pose; expected none, and its points in the frame")


def oldest(stamps_ns: Iterable[int]) -> int | None:
    """The smallest of the stamps that are set; None if there is none."""
    return min((stamp_ns for stamp_ns in stamps_ns if stamp_ns != 0), default=None)


def points_of(marker: Any) -> Array:
    """Centre of a sphere or points of a list, (N, 3), m."""
    points = [marker.pose.position] if marker.type == SPHERE else marker.points
    return np.array([(point.x, point.y, point.z) for point in points]).reshape(-1, 3)
