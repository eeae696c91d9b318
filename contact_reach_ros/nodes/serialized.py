"""Messages of the 1 kHz topics as the bytes that the middleware carries.

Making message objects and taking them apart is most of what a tick in rclpy costs. From one tick to the next only the
numbers in these messages change: they are read and written in place. What does not look like the message before it is
decoded in the usual way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.cdr import (
    ARRAY_COUNT,
    ARRAY_START,
    COUNT,
    HEADER,
    JOINT_STATE_FIELDS,
    NO_LAYOUT,
    PLAIN_CDR,
    STAMP,
    STAMP_END,
    after_string,
    aligned,
    joint_state_counts,
    joint_state_starts,
)
from contact_reach_ros.errors import InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.messages import nanoseconds
from contact_reach_ros.robot.joint_order import JointOrder
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_DOUBLE = np.dtype("<f8")


def decode(data: bytes, message_type: type, topic: str) -> Any:
    """The message that was serialised.

    Raises
    ------
    InputError
        If the bytes are no message of that type; the topic is named.
    """
    try:
        return deserialize_message(data, message_type)
    except rclpy_implementation.RMWError as error:
        name = message_type.__name__
        raise InputError(
            f"{topic}: {len(data)} bytes that are no {name}; expected a serialised {name} ({error})"
        ) from error


class JointSample(NamedTuple):
    """What a JointState says about the arm, joints in the order that was asked for.

    Attributes
    ----------
    stamp_ns
        header.stamp, ns.
    position, velocity
        (7,), rad and rad/s.
    effort
        (7,), N m; None if the message has none, or it was not asked for.
    """

    stamp_ns: int
    position: Array
    velocity: Array
    effort: Array | None


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
        self._order = JointOrder(joints)
        self._topic = topic
        self._with_effort = with_effort
        # Of the last message that was decoded: what must be the same to find the numbers at the same place.
        self._size = -1
        self._names = self._count = b""
        self._names_end = self._velocity_count = 0
        self._start = self._values = 0
        self._position = self._velocity = self._effort = slice(0)
        self._indices: list[int] | None = None

    def read(self, data: bytes) -> JointSample:
        """One message.

        Raises
        ------
        InputError
            If the bytes are no JointState, joints are missing or a field has not one value for each name.
        """
        at = self._velocity_count
        if (
            len(data) != self._size
            or data[STAMP_END : self._names_end] != self._names
            or data[at : at + 4] != self._count
            or not data.startswith(PLAIN_CDR)
        ):
            return self._decode(data)
        seconds, nanosec = STAMP.unpack_from(data, HEADER)
        values = np.frombuffer(data, _DOUBLE, self._values, self._start).copy()
        position, velocity, effort = values[self._position], values[self._velocity], values[self._effort]
        if self._indices is not None:
            position, velocity = position[self._indices], velocity[self._indices]
            effort = effort[self._indices] if len(effort) else effort
        return JointSample(seconds * NANOSECONDS + nanosec, position, velocity, effort if len(effort) else None)

    def _decode(self, data: bytes) -> JointSample:
        self._size = -1
        message: JointState = decode(data, JointState, self._topic)
        effort = None
        position = self._order.pick(message, "position", self._topic)
        velocity = self._order.pick(message, "velocity", self._topic)
        if self._with_effort and message.effort:
            effort = self._order.pick(message, "effort", self._topic)
        self._remember(data, message)
        return JointSample(nanoseconds(message.header.stamp), position, velocity, effort)

    def _remember(self, data: bytes, message: JointState) -> None:
        """Find the numbers in a message whose positions and velocities are complete."""
        if not data.startswith(PLAIN_CDR):
            return
        count = len(message.name)
        starts = joint_state_starts(data)
        self._start, self._names_end = starts[0], joint_state_counts(data)[0] + 4
        self._names = data[STAMP_END : self._names_end]
        self._velocity_count = starts[0] + 8 * count
        self._count = COUNT.pack(count)
        # Between two fields stands the number of values in the second, padded to the size of one value.
        self._position, self._velocity = slice(0, count), slice(count + 1, 2 * count + 1)
        self._values, self._effort = 2 * count + 1, slice(0)
        if self._with_effort and message.effort:
            self._values, self._effort = 3 * count + 2, slice(2 * count + 2, 3 * count + 2)
        self._indices = self._order.indices(message.name, self._topic)
        self._size = len(data)


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
        message = JointState(name=list(names), **{field: [0.0] * len(names) for field in fields})
        message.header.frame_id = frame_id
        data = serialize_message(message)
        # What rclpy makes may be longer than the message.
        self._buffer = bytearray(data[: joint_state_counts(data)[-1]])
        starts = dict(zip(JOINT_STATE_FIELDS, joint_state_starts(self._buffer), strict=True))
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
        data = serialize_message(message)
        start = aligned(after_string(data, STAMP_END))
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
        data = serialize_message(Float64MultiArray(data=[0.0] * count))
        self._buffer = bytearray(data[: ARRAY_START + count * _DOUBLE.itemsize])
        self._values = np.frombuffer(self._buffer, _DOUBLE, count, ARRAY_START)

    def write(self, values: Array) -> bytes:
        """The message with these values."""
        self._values[:] = values
        return bytes(self._buffer)


def read_command(data: bytes) -> Array:
    """The values of a serialised Float64MultiArray, (n,); its layout has no meaning here.

    Raises
    ------
    InputError
        If the bytes are no Float64MultiArray.
    """
    if data.startswith(PLAIN_CDR + NO_LAYOUT) and len(data) > ARRAY_START:
        (count,) = COUNT.unpack_from(data, ARRAY_COUNT)
        if len(data) == ARRAY_START + 8 * count:
            return np.frombuffer(data, _DOUBLE, count, ARRAY_START).copy()
    return np.array(decode(data, Float64MultiArray, topics.COMMANDS.name).data, dtype=float)
