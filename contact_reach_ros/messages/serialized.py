"""Messages of the 1 kHz topics as the bytes that the middleware carries.

Making message objects and taking them apart is most of what a tick in rclpy costs. From one tick to the next only the
numbers in these messages change: they are read and written in place.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import Float64MultiArray

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

SLOT = 0.1
"""Stands for a number that a `MessageWriter` writes; the other bytes of a message never look like it."""

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


class MessageWriter:
    """Writes serialised messages that differ in their numbers, and in the stamp of their header, only.

    Parameters
    ----------
    message
        With `SLOT` in place of each number that is written.
    counts
        Numbers of each array that is written: the bytes behind a message are any, also those of a `SLOT`.
    """

    def __init__(self, message: Any, counts: Sequence[int]) -> None:
        self._buffer = bytearray(encode(message))
        numbers = np.frombuffer(self._buffer, _DOUBLE, (len(self._buffer) - HEADER) // _DOUBLE.itemsize, HEADER)
        slots = np.flatnonzero(numbers == SLOT)
        runs = np.split(slots, np.flatnonzero(np.diff(slots) > 1) + 1)
        self._values = [numbers[run[0] : run[0] + count] for run, count in zip(runs, counts, strict=False)]

    def write(self, *values: Array | Sequence[float], stamp_ns: int | None = None) -> bytes:
        """The message with these values, an array for each field in their order, and this stamp, ns, if it has one."""
        if stamp_ns is not None:
            STAMP.pack_into(self._buffer, HEADER, *divmod(stamp_ns, NANOSECONDS))
        for place, value in zip(self._values, values, strict=True):
            place[:] = value
        return bytes(self._buffer)


def joint_state_writer(names: Sequence[str], frame_id: str, fields: Sequence[str]) -> MessageWriter:
    """Writes JointState messages, of which `fields` are filled: position, velocity or effort."""
    message = JointStateMessage(name=list(names), **{field: [SLOT] * len(names) for field in fields})
    message.header.frame_id = frame_id
    return MessageWriter(message, [len(names)] * len(fields))


def wrench_writer(frame_id: str) -> MessageWriter:
    """Writes WrenchStamped messages, from force and moment, (6,), N and Nm."""
    message = WrenchStamped(wrench=Wrench(**{part: Vector3(x=SLOT, y=SLOT, z=SLOT) for part in ("force", "torque")}))
    message.header.frame_id = frame_id
    return MessageWriter(message, [6])


def command_writer(count: int) -> MessageWriter:
    """Writes Float64MultiArray messages of `count` values without a layout."""
    return MessageWriter(Float64MultiArray(data=[SLOT] * count), [count])


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
