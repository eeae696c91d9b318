"""Messages and their parts from times and arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Transform, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.timing import NANOSECONDS


def to_time(nanoseconds: int) -> Time:
    """Stamp of a time in ns."""
    return Time(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def to_duration(nanoseconds: int) -> Duration:
    """Duration message of a time in ns."""
    return Duration(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def set_time(stamp: Time, time_ns: int) -> None:
    """Write a time in ns into an existing stamp."""
    stamp.sec = time_ns // NANOSECONDS
    stamp.nanosec = time_ns % NANOSECONDS


def to_point(position: Sequence[float]) -> Point:
    """Point message."""
    return Point(x=float(position[0]), y=float(position[1]), z=float(position[2]))


def to_goal_pose(position: Sequence[float], frame: str, stamp: Time, rotation: Array | None = None) -> PoseStamped:
    """A goal for `goal_pose`: a position (3,), m, in a frame, and an orientation (3, 3), by default the identity."""
    goal = PoseStamped()
    goal.header.frame_id = frame
    goal.header.stamp = stamp
    goal.pose.position = to_point(position)
    goal.pose.orientation = to_quaternion(np.eye(3) if rotation is None else rotation)
    return goal


def to_quaternion(rotation: Array) -> Quaternion:
    """Quaternion message of a rotation matrix (3, 3)."""
    # Of a matrix stored row by row Pinocchio's bindings make a copy and never free it.
    x, y, z, w = pin.Quaternion(np.asfortranarray(rotation)).coeffs().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def to_transform(position: Array, rotation: Array) -> Transform:
    """Transform message."""
    x, y, z = position.tolist()
    return Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(rotation))


def to_marker(namespace: str, identifier: int, kind: int, scale: Sequence[float], color: Sequence[float]) -> Marker:
    """Marker without a place: `scale` along x, y and z, m, and `color` as red, green, blue and opacity up to 1."""
    x, y, z = scale
    red, green, blue, opacity = (float(share) for share in color)
    marker = Marker(
        ns=namespace,
        id=identifier,
        type=kind,
        scale=Vector3(x=x, y=y, z=z),
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
    )
    marker.pose.orientation.w = 1.0
    return marker
