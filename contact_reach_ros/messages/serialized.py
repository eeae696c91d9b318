"""Messages of the 1 kHz topics as the bytes that the middleware carries.

Making message objects and taking them apart is most of what a tick in rclpy costs. From one tick to the next only the
numbers in these messages change: they are read and written in place.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import (
    ARRAY_START,
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
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.serialization import deserialize_message

    try:
        return deserialize_message(data, message_type)
    except rclpy_implementation.RMWError as error:
        raise no_message(data, message_type.__name__, topic, error) from error


class JointStateReader:
    """Reads serialised JointState messages.

    Parameters
    ----------
    joints
        The wanted joints in the wanted order.
    topic
        Name for error messages.
    with_effort
        Whether efforts are read, and checked.
    """

    def __init__(self, joints: Sequence[str], topic: str, with_effort: bool = False) -> None:
        self._joints = joints
        self._topic = topic
        self._with_effort = with_effort
        # Frame and names of the last message, which seldom change, and what follows from them.
        self._names, self._names_end = b"", STAMP_END
        self._count = 0
        self._places = np.zeros(0, np.intp)

    def read(self, data: bytes) -> JointState:
        """One state; its torque is None if the message has no efforts, or `with_effort` is not set.

        Raises `InputError` if the bytes are no JointState, joints are missing, a field has not one value for each name,
        or the stamp is no time.
        """
        values, at = [], self._names_end
        try:
            if not self._names or data[STAMP_END:at] != self._names:
                at = self._learn(data)
            seconds, nanosec = STAMP.unpack_from(data, HEADER)
            for _ in JOINT_STATE_FIELDS:
                (count,) = COUNT.unpack_from(data, at)
                at = aligned(at + COUNT.size) if count else at + COUNT.size
                values.append(np.frombuffer(data, _DOUBLE, count, at if count else 0))
                at += 8 * count
        except (struct.error, ValueError) as error:
            self._names = b""
            raise no_message(data, JointStateMessage.__name__, self._topic, error) from error
        position, velocity, effort = values
        has_effort = self._with_effort and len(effort) > 0
        return JointState(
            checked_stamp(seconds, nanosec, self._topic),
            self._wanted(position, "position"),
            self._wanted(velocity, "velocity"),
            self._wanted(effort, "effort") if has_effort else None,
        )

    def _learn(self, data: bytes) -> int:
        """Look for the joints among the names of this message; returns where its fields begin."""
        names, counts = joint_state_layout(data)
        self._places = places_of(self._joints, names, self._topic)
        self._count = len(names)
        self._names_end = counts[0]
        self._names = data[STAMP_END : self._names_end]
        return self._names_end

    def _wanted(self, values: Array, field: str) -> Array:
        if len(values) != self._count:
            raise InputError(
                f"{self._topic}: {field} has {len(values)} values; expected one for each of {self._count} names"
            )
        return values[self._places]


class JointStateWriter:
    """Writes serialised JointState messages.

    Parameters
    ----------
    names
        Content of the field name.
    frame_id
        Content of header.frame_id.
    fields
        Which of position, velocity and effort are filled, one value for each name.
    """

    def __init__(self, names: Sequence[str], frame_id: str, fields: Sequence[str]) -> None:
        message = JointStateMessage(name=list(names), **{field: [0.0] * len(names) for field in fields})
        message.header.frame_id = frame_id
        data = encode(message)
        _, counts = joint_state_layout(data)
        self._buffer = bytearray(data[: counts[-1]])
        starts = {field: aligned(at + COUNT.size) for field, at in zip(JOINT_STATE_FIELDS, counts, strict=False)}
        self._values = [np.frombuffer(self._buffer, _DOUBLE, len(names), starts[field]) for field in fields]

    def write(self, stamp_ns: int, *values: Array | Sequence[float]) -> bytes:
        """The message with this stamp in ns and these values, one array for each of the fields, in their order."""
        STAMP.pack_into(self._buffer, HEADER, *divmod(stamp_ns, NANOSECONDS))
        for place, value in zip(self._values, values, strict=True):
            place[:] = value
        return bytes(self._buffer)


class WrenchWriter:
    """Writes serialised WrenchStamped messages with a given header.frame_id."""

    def __init__(self, frame_id: str) -> None:
        message = WrenchStamped()
        message.header.frame_id = frame_id
        data = encode(message)
        header = Cursor(data, STAMP_END)
        header.skip(1)
        start = aligned(header.at)
        self._buffer = bytearray(data[: start + 6 * _DOUBLE.itemsize])
        self._values = np.frombuffer(self._buffer, _DOUBLE, 6, start)

    def write(self, stamp_ns: int, wrench: Array) -> bytes:
        """The message with this stamp in ns and this force and moment, (6,), N and Nm."""
        STAMP.pack_into(self._buffer, HEADER, *divmod(stamp_ns, NANOSECONDS))
        self._values[:] = wrench
        return bytes(self._buffer)


class CommandWriter:
    """Writes serialised Float64MultiArray messages of `count` values without a layout."""

    def __init__(self, count: int) -> None:
        data = encode(Float64MultiArray(data=[0.0] * count))
        self._buffer = bytearray(data[: ARRAY_START + count * _DOUBLE.itemsize])
        self._values = np.frombuffer(self._buffer, _DOUBLE, count, ARRAY_START)

    def write(self, values: Array) -> bytes:
        """The message with these values."""
        self._values[:] = values
        return bytes(self._buffer)


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
