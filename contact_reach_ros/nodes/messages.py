"""Between messages and arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from numpy.typing import NDArray

from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


def to_time(nanoseconds: int) -> Time:
    """Stamp of a time in ns."""
    return Time(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def to_duration(nanoseconds: int) -> Duration:
    """Duration message of a time in ns."""
    return Duration(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def nanoseconds(stamp: Time | Duration) -> int:
    """Nanoseconds of a stamp or duration."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def set_time(stamp: Time, time_ns: int) -> None:
    """Write a time in ns into an existing stamp."""
    stamp.sec = time_ns // NANOSECONDS
    stamp.nanosec = time_ns % NANOSECONDS


def to_point(position: Sequence[float]) -> Point:
    """Point message."""
    return Point(x=float(position[0]), y=float(position[1]), z=float(position[2]))


def to_quaternion(rotation: Array) -> Quaternion:
    """Quaternion message of a rotation matrix (3, 3)."""
    # Of a matrix stored row by row Pinocchio's bindings make a copy and never free it.
    x, y, z, w = pin.Quaternion(np.asfortranarray(rotation)).coeffs().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def to_pose(position: Array, rotation: Array) -> Pose:
    """Pose message."""
    return Pose(position=to_point(position.tolist()), orientation=to_quaternion(rotation))


def to_transform(position: Array, rotation: Array) -> Transform:
    """Transform message."""
    x, y, z = position.tolist()
    return Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(rotation))


def vector(message: Point | Vector3) -> Array:
    """Position or vector (3,)."""
    return np.array([message.x, message.y, message.z])


def quaternion(message: Quaternion) -> Array:
    """Quaternion as (x, y, z, w)."""
    return np.array([message.x, message.y, message.z, message.w])
