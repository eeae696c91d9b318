"""Messages of the 1 kHz topics as the bytes that the middleware carries.

Making message objects and taking them apart is most of what a tick in rclpy costs. From one tick to the next only the
numbers in these messages change: they are read and written in place.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import Float64MultiArray, Header

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import (
    COUNT,
    HEADER,
    JOINT_STATE_FIELDS,
    STAMP,
    STAMP_END,
    Cursor,
    aligned,
    joint_state_layout,
    no_message,
)
from contact_reach_ros.messages.values import checked_stamp, places_of
from contact_reach_ros.timing import NANOSECONDS

_FIRST_MARK = 1e6
_STAMP = (0x51EC51EC, 0x1A2B3C4D)
STAMP_NS = _STAMP[0] * NANOSECONDS + _STAMP[1]
"""Stands for the stamps that a `MessageWriter` writes."""

_DOUBLE = np.dtype("<f8")
_SIZE_AND_STRIDE = struct.Struct("<2I")


def encode(message: Any) -> bytes:
    """Serialise a message; up to eight bytes of padding may follow it."""
    # rclpy is imported only where a whole message has to be converted.
    from rclpy.serialization import serialize_message

    data: bytes = serialize_message(message)
    return data


def decode(data: bytes, message_type: type, topic: str) -> Any:
    """Deserialise a message.

    Raises `InputError` if the bytes are no message of that type; the topic is named.
    """
    from rclpy.serialization import deserialize_message

    try:
        return deserialize_message(data, message_type)
    except RuntimeError as error:
        raise no_message(data, message_type.__name__, topic, error) from error


class JointStateReader:
    """Reads serialised JointState messages.

    Parameters
    ----------
    joints
        The wanted joints in the wanted order.
    topic
        Name for error messages.
    """

    def __init__(self, joints: Sequence[str], topic: str) -> None:
        self._joints = joints
        self._topic = topic
        # What the last message had besides numbers, where it stood, and where the wanted numbers follow from that.
        self._fixed: list[bytes] | None = None
        self._parts: list[slice] = []
        self._slots: list[NDArray[np.intp]] = []
        self._count = 0

    def read(self, data: bytes) -> JointState:
        """One state; its torque is None if the message has no efforts.

        Raises `InputError` if the bytes are no JointState, joints are missing, a field has not one value for each name,
        or the stamp is no time.
        """
        try:
            if [data[part] for part in self._parts] != self._fixed:
                self._learn(data)
            seconds, nanosec = STAMP.unpack_from(data, HEADER)
            numbers = np.frombuffer(data, _DOUBLE, self._count, HEADER)
        except (struct.error, ValueError) as error:
            raise no_message(data, JointStateMessage.__name__, self._topic, error) from error
        position, velocity, *effort = [numbers[slots] for slots in self._slots]
        stamp_ns = checked_stamp(seconds, nanosec, self._topic)
        return JointState(stamp_ns, position, velocity, effort[0] if effort else None)

    def _learn(self, data: bytes) -> None:
        """Find the wanted numbers in a message whose names, or numbers of values, differ from the last one's."""
        self._fixed, self._parts, self._slots = None, [], []
        names, counts = joint_state_layout(data)
        places = places_of(self._joints, names, self._topic)
        for field, at in zip(JOINT_STATE_FIELDS, counts, strict=False):
            (count,) = COUNT.unpack_from(data, at)
            if field == "effort" and not count:
                break
            if count != len(names):
                raise InputError(
                    f"{self._topic}: {field} has {count} values; expected one for each of {len(names)} names"
                )
            self._slots.append((aligned(at + COUNT.size) - HEADER) // _DOUBLE.itemsize + places)
        self._count = (counts[-1] - HEADER) // _DOUBLE.itemsize
        self._parts = [slice(STAMP_END, counts[0]), *(slice(at, at + COUNT.size) for at in counts[:-1])]
        self._fixed = [data[part] for part in self._parts]


def marks(count: int) -> Array:
    """Numbers (count,) that stand for those that a `MessageWriter` writes; nothing else in a message is like them."""
    return _FIRST_MARK + np.arange(count, dtype=float)


class MessageWriter:
    """Writes serialised messages that differ in their numbers and stamps only: it is serialised once, with marks.

    Each time, numbers and stamps are written to where the marks lie.
    """

    def __init__(self, message: Any, count: int) -> None:
        """`message`: with the `marks` of as many numbers as are written, in any order and repeated, and `STAMP_NS`."""
        self._buffer = bytearray(encode(message))
        # CDR aligns numbers to their size, counted from the end of its header.
        size = len(self._buffer) - HEADER
        self._numbers = np.frombuffer(self._buffer, _DOUBLE, size // 8, HEADER)
        self._words = np.frombuffer(self._buffer, "<u4", size // 4, HEADER)
        self._slots = np.flatnonzero(np.isin(self._numbers, marks(count)))
        self._sources = (self._numbers[self._slots] - _FIRST_MARK).astype(int)
        is_stamp = [self._words[place : size // 4 - 1 + place] == part for place, part in enumerate(_STAMP)]
        self._stamps = np.flatnonzero(np.logical_and(*is_stamp))

    def write(self, *values: Array | Sequence[float], stamp_ns: int = 0) -> bytes:
        """The message with these numbers, one array after the other, and this stamp, ns, if it has one."""
        self._numbers[self._slots] = np.concatenate(values).ravel()[self._sources]
        self._words[self._stamps], self._words[self._stamps + 1] = divmod(stamp_ns, NANOSECONDS)
        return bytes(self._buffer)


def joint_state_writer(names: Sequence[str], frame_id: str, fields: Sequence[str]) -> MessageWriter:
    """Writes JointState messages, of which `fields` are filled, one after the other: position, velocity or effort."""
    count = len(names) * len(fields)
    parts = np.split(marks(count), len(fields))
    message = JointStateMessage(name=list(names), **dict(zip(fields, map(list, parts), strict=True)))
    message.header = Header(stamp=Time(sec=_STAMP[0], nanosec=_STAMP[1]), frame_id=frame_id)
    return MessageWriter(message, count)


def wrench_writer(frame_id: str) -> MessageWriter:
    """Writes WrenchStamped messages, from force and moment, (6,), N and Nm."""
    x, y, z, *torque = marks(6).tolist()
    wrench = Wrench(force=Vector3(x=x, y=y, z=z), torque=Vector3(**dict(zip("xyz", torque, strict=True))))
    header = Header(stamp=Time(sec=_STAMP[0], nanosec=_STAMP[1]), frame_id=frame_id)
    return MessageWriter(WrenchStamped(header=header, wrench=wrench), 6)


def command_writer(count: int) -> MessageWriter:
    """Writes Float64MultiArray messages of `count` values without a layout."""
    return MessageWriter(Float64MultiArray(data=marks(count).tolist()), count)


def read_command(data: bytes) -> Array:
    """The values of a serialised Float64MultiArray, (n,); its layout has no meaning here.

    Raises `InputError` if the bytes are no Float64MultiArray.
    """
    try:
        cursor = Cursor(data)
        for _ in range(cursor.count()):
            cursor.skip(1)  # label
            cursor.numbers(_SIZE_AND_STRIDE)
        cursor.numbers(COUNT)  # data_offset
        start, end = cursor.skip(8, 8)
        return np.frombuffer(data, _DOUBLE, (end - start) // 8, start if end > start else 0).copy()
    except (struct.error, ValueError) as error:
        raise no_message(data, Float64MultiArray.__name__, topics.COMMANDS.name, error) from error
