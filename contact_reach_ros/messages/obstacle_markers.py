"""Writes obstacles as visualization markers; `obstacle_reader` explains how these stand for obstacles."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Quaternion
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm import Array
from contact_reach_ros.messages.cdr import HEADER
from contact_reach_ros.messages.conversions import to_marker, to_point, to_time
from contact_reach_ros.messages.obstacle_reader import BLOCK, EDGES, FIXED, OBSTACLES, PLANE, REST, STIFFNESS
from contact_reach_ros.messages.serialized import encode
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.rigid import Plane, RigidBody, slab
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import rest_positions

_GREEN = (0.35, 0.7, 0.35)
_GREY = (0.45, 0.45, 0.45)
_EDGE_WIDTH = 0.004
_FIRST_MARK = 1e6
_STAMP = (0x51EC51EC, 0x1A2B3C4D)
_STAMP_NS = _STAMP[0] * NANOSECONDS + _STAMP[1]


def obstacle_markers(scene: Scene, positions: Array, stamp_ns: int) -> MarkerArray:
    """The obstacles of a scene at `positions` (K, 3), m, in the order of `rest_positions`, and its rigid bodies."""
    markers: list[Marker] = []
    ends = np.cumsum([len(obstacle.rest) for obstacle in scene.obstacles])
    for number, (obstacle, places) in enumerate(zip(scene.obstacles, np.split(positions, ends), strict=False)):
        markers += _markers_of(obstacle, number, places)
    markers += [_rigid_marker(body, number) for number, body in enumerate(scene.environment)]
    for marker in markers:
        marker.header = Header(stamp=to_time(stamp_ns), frame_id=scene.arm.base_frame)
    return MarkerArray(markers=markers)


class ObstacleMarkerWriter:
    """Serialised obstacle messages, fast enough for a 1 kHz loop.

    Of the hundreds of points in a message only the coordinates change, and the stamps: the message is serialised once,
    and each time they are written to where they lie in it.
    """

    def __init__(self, scene: Scene) -> None:
        marks = _FIRST_MARK + np.arange(3 * len(rest_positions(scene)), dtype=float)
        self._buffer = bytearray(encode(obstacle_markers(scene, marks.reshape(-1, 3), _STAMP_NS)))
        # CDR aligns numbers to their size, counted from the end of its header.
        size = len(self._buffer) - HEADER
        self._numbers = np.frombuffer(self._buffer, "<f8", size // 8, HEADER)
        self._words = np.frombuffer(self._buffer, "<u4", size // 4, HEADER)
        self._slots = np.flatnonzero(np.isin(self._numbers, marks))
        self._sources = (self._numbers[self._slots] - _FIRST_MARK).astype(int)
        is_stamp = [self._words[place : size // 4 - 1 + place] == part for place, part in enumerate(_STAMP)]
        self._stamps = np.flatnonzero(np.logical_and(*is_stamp))

    def write(self, positions: Array, stamp_ns: int) -> bytes:
        """A serialised MarkerArray with the obstacles at `positions` (K, 3), m."""
        self._numbers[self._slots] = positions.ravel()[self._sources]
        self._words[self._stamps] = stamp_ns // NANOSECONDS
        self._words[self._stamps + 1] = stamp_ns % NANOSECONDS
        return bytes(self._buffer)


def _markers_of(obstacle: Obstacle, number: int, places: Array) -> list[Marker]:
    free, ends, diameter = ~obstacle.fixed, obstacle.edges.ravel(), 2.0 * obstacle.radius
    is_ball = len(free) == 1 and free.all()
    kind = Marker.SPHERE if is_ball else Marker.SPHERE_LIST
    table = [
        (OBSTACLES, kind, diameter, (*_GREEN, 1.0), places[free]),
        (REST, kind, diameter, (*_GREEN, 0.1), obstacle.rest[free]),
    ]
    if not is_ball:
        table.append((FIXED, kind, diameter, (*_GREY, 1.0), places[obstacle.fixed]))
        table.append((EDGES, Marker.LINE_LIST, _EDGE_WIDTH, (*_GREEN, 0.6), places[ends]))
    markers = []
    for namespace, shape, scale, color, points in table:
        marker = to_marker(namespace, number, shape, 3 * [scale], color)
        marker.points = [to_point(point) for point in points.tolist()]
        if is_ball:
            (marker.pose.position,), marker.points = marker.points, []
        if namespace == EDGES and np.ptp(obstacle.edge_stiffness):
            numbers = [obstacle.material.damping, *obstacle.edge_stiffness]
            marker.text = STIFFNESS + " ".join(f"{number:.6g}" for number in numbers)
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
