"""Reads obstacles from visualization markers, in the bytes that the middleware carries.

To make a Python object of each of the hundreds of points in a message takes milliseconds; here they become arrays.

A ball is a SPHERE, as large as its longest axis. A deformable body is a SPHERE_LIST of the nodes that can move, one of
those that are fixed, and a LINE_LIST of the edges that join them, told apart by their namespaces and held together by
one id. Where edges differ in stiffness, their text, 'stiffness' and numbers, has the damping of a node, N s/m, and
the stiffness of each edge, N/m. A rigid body is a CUBE, in namespace 'plane' with everything behind the face to which
its z axis points.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import FrameError, InputError
from contact_reach_ros.messages.cdr import STAMP, Cursor, no_message
from contact_reach_ros.planning.settings import PlannerNodeSettings
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.rigid import Block, Plane, RigidBody
from contact_reach_ros.world.spheres import FIXED_STIFFNESS, Spheres

OBSTACLES = "obstacles"
FIXED = "fixed"
EDGES = "edges"
REST = "rest"
PLANE = "plane"
BLOCK = "block"

STIFFNESS = "stiffness "
"""Begins the text of edges that differ."""

_ADD = 0
_CUBE, _SPHERE, _LINE_LIST, _SPHERE_LIST = 1, 2, 5, 7
"""Action and types of a visualization_msgs/msg/Marker."""

_OF_BODIES = (OBSTACLES, REST, FIXED, EDGES)

SPHERE_DAMPING, NODE_DAMPING = 30.0, 5.0
"""Damping of the motion of a ball, and of a node of a deformable body, N s/m: as the shipped scenes have it."""

_MATCH = 1e-4
"""How far the end of an edge may be from its node, m."""

_FLAG, _IDS, _POSE_AND_SCALE = struct.Struct("<?"), struct.Struct("<3i"), struct.Struct("<10d")
_COLOR_TO_LOCKED = 16 + 8 + 1
"""Bytes of color, lifetime and frame_locked."""


class _Marker(NamedTuple):
    """What a marker says of an obstacle; lengths in m."""

    stamp_ns: int
    frame: str
    namespace: str
    id: int
    type: int
    action: int
    position: tuple[float, ...]
    """x, y, z."""
    orientation: tuple[float, ...]
    """x, y, z, w."""
    scale: tuple[float, ...]
    """Along x, y, z."""
    points: Array
    """(N, 3)."""
    text: str


_Body = tuple[int, str]
"""Id of a body, and its namespace if that is none of `_OF_BODIES`."""


class ObstacleMarkerReader:
    """Reads spheres, the edges between them, and rigid bodies from marker arrays.

    Parameters
    ----------
    frame
        In which markers must be: the arm's base frame.
    settings
        Stiffness of obstacles, which markers do not carry; None for the defaults.

    Attributes
    ----------
    stamp_ns
        When the obstacles of the last message were seen: the oldest stamp of their markers, ns; None if none has a
        stamp, as in an empty message.
    """

    def __init__(self, frame: str, settings: PlannerNodeSettings | None = None) -> None:
        self.stamp_ns: int | None = None
        self._frame = frame
        self._settings = settings or PlannerNodeSettings()
        self._rests: dict[_Body, Array] = {}

    def read(self, data: bytes) -> Spheres:
        """The spheres of a MarkerArray: in the order of their ids, and of each body the nodes that can move first.

        Springs hold spheres and nodes where the namespace 'rest' has them, or else where they were seen first,
        for as long as each message has them.

        Raises
        ------
        FrameError
            If a marker is in another frame.
        InputError
            If the bytes are no MarkerArray, a marker is of another type than its namespace needs, has no size or a
            value that is not finite, or an edge ends where no node is; the marker is named.
        """
        try:
            cursor = Cursor(data)
            markers = [_next_marker(cursor) for _ in range(cursor.count())]
        except (struct.error, ValueError) as error:
            raise no_message(data, "MarkerArray", "obstacles", error) from error
        bodies: dict[_Body, dict[str, _Marker]] = {}
        environment: list[RigidBody] = []
        seen: set[tuple[bool, str, int]] = set()
        for marker in markers:
            if marker.frame != self._frame:
                raise FrameError(f"obstacles: header.frame_id is '{marker.frame}'; expected '{self._frame}'")
            # Spheres may be in any other namespace too, as perception calls them.
            is_own = marker.namespace in _OF_BODIES
            kind, body = marker.namespace if is_own else OBSTACLES, (marker.id, "" if is_own else marker.namespace)
            key = marker.type == _CUBE, marker.namespace, marker.id
            if key in seen:
                raise _refusal(marker, "comes twice; expected each namespace and id once")
            seen.add(key)
            if marker.type == _CUBE:
                environment.append(_rigid_body(marker))
            else:
                bodies.setdefault(body, {})[kind] = _checked(marker, kind)
        rests = {name: rest for name, rest in self._rests.items() if name in bodies}
        rests |= {name: body[REST].points for name, body in bodies.items() if REST in body}
        parts, count = [_NO_SPHERES], 0
        for name, parts_of_it in sorted(bodies.items()):
            parts.append(self._spheres(name, parts_of_it, rests, count))
            count += len(parts[-1]["center"])
        columns = {name: np.concatenate([part[name] for part in parts]) for name in _NO_SPHERES}
        spheres = Spheres(**columns, environment=tuple(environment))
        self._rests = rests
        self.stamp_ns = min((marker.stamp_ns for marker in markers if marker.stamp_ns), default=None)
        return spheres

    def _spheres(
        self, name: _Body, body: dict[str, _Marker], rests: dict[_Body, Array], first: int
    ) -> dict[str, Array]:
        """Fields of `Spheres` for one body, whose first sphere is number `first`; adds an unknown rest to `rests`."""
        number = name[0]
        movable, fixed = (body[kind].points if kind in body else np.zeros((0, 3)) for kind in (OBSTACLES, FIXED))
        rest = rests.setdefault(name, movable)
        if len(rest) != len(movable) and REST not in body:
            # Another body with the same name.
            rest = rests[name] = movable
        if len(rest) != len(movable):
            raise InputError(
                f"obstacles: marker {REST}/{number} has {len(rest)} points; expected {len(movable)}, one for each "
                "node that can move"
            )
        is_ball = OBSTACLES in body and body[OBSTACLES].type == _SPHERE
        if len(movable) and not is_ball and EDGES not in body:
            raise _refusal(body[OBSTACLES], "is a SPHERE_LIST that no edges hold; expected a SPHERE for each ball")
        stiffness = self._settings.sphere_stiffness if is_ball else 0.0
        nodes = np.concatenate([movable, fixed])
        edges = _joined(number, body[EDGES].points if EDGES in body else np.zeros((0, 3)), nodes)
        damping, edge_stiffness = NODE_DAMPING, np.full(len(edges), self._settings.edge_stiffness)
        if EDGES in body and body[EDGES].text.startswith(STIFFNESS):
            damping, edge_stiffness = _stated(body[EDGES], len(edges))
        counts = [len(movable), len(fixed)]
        radii = [0.5 * max(body[kind].scale) if kind in body else 0.0 for kind in (OBSTACLES, FIXED)]
        return {
            "center": nodes,
            "rest": np.concatenate([rest, fixed]),
            "radius": np.repeat(radii, counts),
            "stiffness": np.repeat([stiffness, FIXED_STIFFNESS], counts),
            "damping": np.full(len(nodes), SPHERE_DAMPING if is_ball else damping),
            "edges": edges + first,
            "edge_stiffness": edge_stiffness,
        }


_NO_SPHERES: dict[str, Array] = {name: value for name, value in vars(Spheres.none()).items() if name != "environment"}


def _joined(number: int, ends: Array, nodes: Array) -> NDArray[np.intp]:
    """Which nodes (N, 3) the edges (2 E, 3) of a body join, (E, 2)."""
    if len(ends) % 2:
        raise InputError(f"obstacles: marker {EDGES}/{number} has {len(ends)} points; expected an even number")
    if not len(ends):
        return np.zeros((0, 2), np.intp)
    # Imported where it is needed: a third of the start of a driver without such bodies.
    from scipy.spatial import cKDTree

    # An edge without any nodes ends far away from one.
    distances, nearest = cKDTree(nodes if len(nodes) else np.full((1, 3), 1e9)).query(ends)
    if distances.max() > _MATCH:
        index = int(distances.argmax())
        raise InputError(
            f"obstacles: marker {EDGES}/{number}: edge {index // 2} ends at {np.round(ends[index], 4).tolist()} m, "
            f"where no node is; expected a point of {OBSTACLES}/{number} or {FIXED}/{number}"
        )
    return nearest.reshape(-1, 2).astype(np.intp)


def _stated(marker: _Marker, edges: int) -> tuple[float, Array]:
    """Damping of a node, N s/m, and stiffness of each edge (E,), N/m, in the text of a marker of edges."""
    try:
        numbers = np.array(marker.text.removeprefix(STIFFNESS).split(), float)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 1 + edges or not ((numbers > 0.0) & np.isfinite(numbers)).all():
        raise _refusal(
            marker, f"has text '{marker.text[:40]}'; expected {1 + edges} positive numbers after '{STIFFNESS}'"
        )
    return float(numbers[0]), numbers[1:]


def _refusal(marker: _Marker, why: str) -> InputError:
    return InputError(f"obstacles: marker {marker.namespace}/{marker.id} {why}")


def _checked(marker: _Marker, kind: str) -> _Marker:
    """A marker of spheres or edges; raises `InputError` if it does not fit its namespace."""
    types = (_LINE_LIST,) if kind == EDGES else (_SPHERE, _SPHERE_LIST)
    if marker.action != _ADD or marker.type not in types:
        expected = "LINE_LIST" if kind == EDGES else "SPHERE or SPHERE_LIST"
        raise _refusal(marker, f"has type {marker.type} and action {marker.action}; expected {expected}, to ADD")
    if kind in (OBSTACLES, FIXED) and not (all(0.0 <= side < np.inf for side in marker.scale) and any(marker.scale)):
        raise _refusal(marker, f"has scale = {list(marker.scale)}; expected a diameter in m")
    if marker.type != _SPHERE and (any(marker.position) or any(marker.orientation[:3])):
        raise _refusal(marker, "has a pose; expected none, and its points in the frame")
    points = np.array([marker.position]) if marker.type == _SPHERE else marker.points
    if not np.isfinite(points).all():
        index = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise _refusal(marker, f"has point {index} at {points[index].tolist()}; expected finite values")
    return marker._replace(points=points)


def _rigid_body(marker: _Marker) -> RigidBody:
    """The rigid body of a CUBE, named by its text; raises `InputError` if it has no pose or size."""
    if marker.action != _ADD:
        raise _refusal(marker, f"has action {marker.action}; expected CUBE, to ADD")
    name = marker.text or f"{marker.namespace}/{marker.id}"
    try:
        block = Block(name, marker.position, marker.scale, marker.orientation)
    except InputError as error:
        raise _refusal(marker, f"is no body: {error}") from error
    if marker.namespace != PLANE:
        return block
    up = block.axes[:, 2]
    return Plane(block.name, np.array(marker.position) + 0.5 * marker.scale[2] * up, up)


def _next_marker(cursor: Cursor) -> _Marker:
    """The marker at the cursor, which then stands behind it."""
    seconds, nanosec = cursor.numbers(STAMP)
    frame, namespace = cursor.text(), cursor.text()
    number, kind, action = cursor.numbers(_IDS)
    place = cursor.numbers(_POSE_AND_SCALE, 8)
    cursor.at += _COLOR_TO_LOCKED
    start, end = cursor.skip(24, 8)
    points = np.frombuffer(cursor.data, "<f8", (end - start) // 8, start if end > start else 0).reshape(-1, 3)
    cursor.skip(16, 4)  # colors
    cursor.skip(1)  # texture_resource
    cursor.numbers(STAMP)  # texture.header
    for _ in range(3):  # frame_id, texture.format, texture.data
        cursor.skip(1)
    cursor.skip(8, 4)  # uv_coordinates
    text = cursor.text()
    for _ in range(3):  # mesh_resource, mesh_file.filename, mesh_file.data
        cursor.skip(1)
    cursor.numbers(_FLAG, 1)  # mesh_use_embedded_materials
    stamp_ns = seconds * NANOSECONDS + nanosec
    return _Marker(stamp_ns, frame, namespace, number, kind, action, place[:3], place[3:7], place[7:], points, text)
