"""Obstacles as visualization markers, written and read in the bytes that the middleware carries.

`obstacle_reader` explains how markers stand for obstacles.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from geometry_msgs.msg import Quaternion
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arrays import Array
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import set_time, to_marker, to_point
from contact_reach_ros.messages.obstacle_material import BodyMaterial, material_text
from contact_reach_ros.messages.obstacle_reader import (
    BLOCK,
    CUBE,
    EDGES,
    FIXED,
    OBSTACLES,
    PLANE,
    REST,
    SPHERE,
    AssumedMaterial,
    ObstacleMarkerReader,
    Shape,
    oldest,
    shapes_of,
)
from contact_reach_ros.messages.serialization import decode, encode
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.world.obstacle import Material, Obstacle
from contact_reach_ros.world.rigid import Environment, Plane, RigidBody, slab
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, by_obstacle, rest_positions

_GREEN = (0.35, 0.7, 0.35)
_GREY = (0.45, 0.45, 0.45)
_EDGE_WIDTH = 0.004
_FIRST_MARK = 1e6
_STAMP_NS = 0x51EC51EC * NANOSECONDS + 0x1A2B3C4D


def obstacle_markers(scene: Scene, positions: Array, stamp_ns: int) -> MarkerArray:
    """The obstacles of a scene at `positions` (K, 3), m, in the order of `rest_positions`, and its rigid bodies.

    Where the balls of a scene, or its meshes, are not all of one material, which the planner's parameters could state,
    their markers carry it.
    """
    markers: list[Marker] = []
    differs = {
        is_ball: _differ(obstacle for obstacle in scene.obstacles if _is_ball(obstacle) == is_ball)
        for is_ball in (False, True)
    }
    for obstacle, places in by_obstacle(scene, positions):
        is_ball = _is_ball(obstacle)
        made = _ball_markers(obstacle, places) if is_ball else _body_markers(obstacle, places)
        if differs[is_ball]:
            made[0].text = material_text(_seen(obstacle.material))
        markers += made
    markers += [_rigid_marker(body, number) for number, body in enumerate(scene.environment)]
    for marker in markers:
        marker.header.frame_id = scene.arm.base_frame
        set_time(marker.header.stamp, stamp_ns)
    return MarkerArray(markers=markers)


class ObstacleMarkerWriter:
    """Serialised obstacle messages, fast enough for a 1 kHz loop.

    Of the hundreds of points in a message only the coordinates change, and the stamps: the message is serialised once,
    and each time they are written to where they lie in it.
    """

    def __init__(self, scene: Scene) -> None:
        marks = _FIRST_MARK + np.arange(3 * len(rest_positions(scene)), dtype=float)
        self._buffer = bytearray(encode(obstacle_markers(scene, marks.reshape(-1, 3), _STAMP_NS)))
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


class SerializedObstacleReader(ObstacleMarkerReader):
    """Spheres, and the edges between them, from serialised marker arrays."""

    def __init__(self, frame: str, material: AssumedMaterial) -> None:
        super().__init__(frame, material)
        self._layout: _Layout | None = None

    def read_serialized(self, data: bytes) -> Spheres:
        """The same as `read` for a serialised message.

        Turning hundreds of points into Python objects takes milliseconds. So their places in the message are kept, and
        the next one is read without that as long as nothing but points and stamps has changed.

        Raises
        ------
        InputError
            As `read`, or if the bytes are no message.
        """
        if self._layout is not None and self._layout.fits(data):
            spheres = self.spheres(self._layout.read(data), self._layout.environment)
            self.stamp_ns = oldest(self._layout.stamps(data))
            return spheres
        message: MarkerArray = decode(data, MarkerArray, topics.OBSTACLES.name)
        spheres, shapes = self.read(message), shapes_of(message, self._frame)
        if self._layout is None or not self._layout.learn(data, shapes, spheres.environment):
            self._layout = _Layout(data, message, shapes, spheres.environment)
        return spheres


class _Layout:
    """Where the points lie in a serialised message, and which of its bytes have to stay as they are."""

    def __init__(self, data: bytes, message: MarkerArray, shapes: list[Shape], environment: Environment) -> None:
        """`message`: `data` decoded, whose points and stamps are overwritten."""
        self._data = np.frombuffer(data, np.uint8)
        self.environment = environment
        self._shapes = shapes
        self._ends = np.cumsum([shape.points for shape in shapes])
        count = int(self._ends[-1]) if shapes else 0
        marks = _FIRST_MARK + np.arange(3 * count, dtype=float)
        points = iter(marks.reshape(-1, 3).tolist())
        for marker in message.markers:
            if marker.type == SPHERE:
                marker.pose.position = to_point(next(points))
            elif marker.type != CUBE:
                marker.points = [to_point(next(points)) for _ in marker.points]
            set_time(marker.header.stamp, _STAMP_NS)
        marked = bytearray(encode(message))
        self._slots, self._stamps = _marked_numbers(marked, marks), _marked_stamps(marked)
        is_same = np.ones(len(marked), bool)
        is_same[4 + (8 * self._slots[:, None] + np.arange(8))] = False
        is_same[4 + (4 * self._stamps[:, None] + np.arange(8))] = False
        self._same = np.flatnonzero(is_same)
        # A message in another byte order, for one, is always read in full.
        self._usable = data[:2] == bytes(marked[:2]) and len(data) == len(marked) and len(self._slots) == 3 * count

    def fits(self, data: bytes) -> bool:
        """Whether nothing has changed but points and stamps."""
        if not self._usable or len(data) != len(self._data):
            return False
        return bool((np.frombuffer(data, np.uint8)[self._same] == self._data[self._same]).all())

    def learn(self, data: bytes, shapes: list[Shape], environment: Environment) -> bool:
        """Ignore from now on where an equivalent message differs: gaps between fields, colours. False for any other."""
        is_same = shapes == self._shapes and environment == self.environment
        is_equivalent = self._usable and len(data) == len(self._data) and is_same
        if is_equivalent:
            self._same = self._same[np.frombuffer(data, np.uint8)[self._same] == self._data[self._same]]
        return is_equivalent

    def read(self, data: bytes) -> list[tuple[Shape, Array]]:
        """The points of a message that fits, by marker."""
        points = np.split(_numbers(data)[self._slots].reshape(-1, 3), self._ends[:-1])
        return list(zip(self._shapes, points, strict=False))

    def stamps(self, data: bytes) -> list[int]:
        """The markers' stamps in a message that fits, ns."""
        words = _words(data)
        seconds = words[self._stamps].astype(np.int32).astype(np.int64)
        stamps: list[int] = (seconds * NANOSECONDS + words[self._stamps + 1]).tolist()
        return stamps


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


def _is_ball(obstacle: Obstacle) -> bool:
    return len(obstacle.rest) == 1 and not obstacle.fixed.any()


def _seen(material: Material) -> BodyMaterial:
    """The material as the planner's model has it."""
    scale = material.planner_scale
    return BodyMaterial(scale * material.stiffness, material.damping, scale * material.edge_stiffness)


def _differ(obstacles: Iterable[Obstacle]) -> bool:
    return len({_seen(obstacle.material) for obstacle in obstacles}) > 1


def _ball_markers(ball: Obstacle, places: Array) -> list[Marker]:
    markers = []
    for namespace, centers, opacity in ((OBSTACLES, places, 1.0), (REST, ball.rest, 0.15)):
        marker = to_marker(namespace, ball.id, Marker.SPHERE, 3 * [2.0 * ball.radius], (*_GREEN, opacity))
        marker.pose.position = to_point(centers[0].tolist())
        markers.append(marker)
    return markers


def _body_markers(body: Obstacle, nodes: Array) -> list[Marker]:
    diameter = 2.0 * body.radius
    free, ends = ~body.fixed, body.edges.ravel()
    table = (
        (OBSTACLES, Marker.SPHERE_LIST, diameter, (*_GREEN, 1.0), nodes[free]),
        (FIXED, Marker.SPHERE_LIST, diameter, (*_GREY, 1.0), nodes[body.fixed]),
        (EDGES, Marker.LINE_LIST, _EDGE_WIDTH, (*_GREEN, 0.6), nodes[ends]),
        (REST, Marker.SPHERE_LIST, diameter, (*_GREEN, 0.1), body.rest[free]),
    )
    markers = []
    for namespace, kind, scale, color, points in table:
        marker = to_marker(namespace, body.id, kind, 3 * [scale], color)
        marker.points = [to_point(point) for point in points.tolist()]
        markers.append(marker)
    return markers


def _rigid_marker(body: RigidBody, identifier: int) -> Marker:
    """A CUBE, for a plane one whose upper face lies on it."""
    shown = slab(body)
    namespace = PLANE if isinstance(body, Plane) else BLOCK
    marker = to_marker(namespace, identifier, Marker.CUBE, list(shown.size), (*_GREY, 0.6))
    marker.text = body.name
    marker.pose.position = to_point(list(shown.center))
    marker.pose.orientation = Quaternion(**dict(zip("xyzw", shown.orientation, strict=True)))
    return marker
