"""Between messages and arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError
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
    x, y, z, w = pin.Quaternion(rotation).coeffs().tolist()
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


class JointOrder:
    """Picks the arm's joints out of messages whose order may be any, and may change."""

    def __init__(self, names: Sequence[str]) -> None:
        """`names`: the wanted joints in the wanted order."""
        self._names = list(names)
        self._seen: list[str] = []
        self._indices: list[int] | None = None

    def indices(self, names: list[str], topic: str) -> list[int] | None:
        """Where the wanted joints stand among `names`; None if they stand there in order.

        Raises
        ------
        InputError
            If joints are missing; topic, field and the missing names are said.
        """
        if names != self._seen:
            missing = [name for name in self._names if name not in names]
            if missing:
                raise InputError(
                    f"{topic}: field name lacks {', '.join(missing)}; expected all of {', '.join(self._names)}"
                )
            self._indices = None if names == self._names else [names.index(name) for name in self._names]
            self._seen = list(names)
        return self._indices

    def pick(self, message: Any, field: str, topic: str) -> Array:
        """One field of a JointState, (7,), in the wanted order.

        Raises
        ------
        InputError
            If joints are missing or the field has not one value for each name.
        """
        indices = self.indices(message.name, topic)
        values = np.array(getattr(message, field), dtype=float)
        if len(values) != len(self._seen):
            raise InputError(
                f"{topic}: {field} has {len(values)} values; expected one for each of {len(self._seen)} names"
            )
        return values if indices is None else values[indices]
