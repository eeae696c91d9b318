"""Messages of the 1 kHz topics as the bytes that the middleware carries.

Making message objects and taking them apart is most of what a tick in rclpy costs. From one tick to the next only the
numbers in these messages change: they are read and written in place. What does not look like the message before it is
decoded in the usual way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState as JointStateMessage
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import (
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
from contact_reach_ros.messages.serialization import decode, encode
from contact_reach_ros.messages.values import JointOrder, checked_stamp
from contact_reach_ros.timing import NANOSECONDS

_DOUBLE = np.dtype("<f8")


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
        # Parts of the last decoded message: with the same ones, another has its numbers at the same places.
        self._size = -1
        self._names = self._count = b""
        self._names_end = self._velocity_count = 0
        self._start = self._values = 0
        self._position = self._velocity = self._effort = slice(0)
        self._indices: list[int] | None = None

    def read(self, data: bytes) -> JointState:
        """One state; its torque is None if the message has no efforts, or `with_effort` is not set.

        Raises `InputError` if the bytes are no JointState, joints are missing, a field has not one value for each name,
        or the stamp is no time.
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
        stamp_ns = checked_stamp(seconds, nanosec, self._topic)
        return JointState(stamp_ns, position, velocity, effort if len(effort) else None)

    def _decode(self, data: bytes) -> JointState:
        self._size = -1
        message: JointStateMessage = decode(data, JointStateMessage, self._topic)
        effort = None
        position = self._order.pick(message, "position", self._topic)
        velocity = self._order.pick(message, "velocity", self._topic)
        if self._with_effort and message.effort:
            effort = self._order.pick(message, "effort", self._topic)
        stamp = message.header.stamp
        stamp_ns = checked_stamp(stamp.sec, stamp.nanosec, self._topic)
        self._remember(data, message)
        return JointState(stamp_ns, position, velocity, effort)

    def _remember(self, data: bytes, message: JointStateMessage) -> None:
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
        message = JointStateMessage(name=list(names), **{field: [0.0] * len(names) for field in fields})
        message.header.frame_id = frame_id
        data = encode(message)
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
        data = encode(message)
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
    if data.startswith(PLAIN_CDR + NO_LAYOUT) and len(data) > ARRAY_START:
        (count,) = COUNT.unpack_from(data, ARRAY_COUNT)
        if len(data) == ARRAY_START + 8 * count:
            return np.frombuffer(data, _DOUBLE, count, ARRAY_START).copy()
    return np.array(decode(data, Float64MultiArray, topics.COMMANDS.name).data, dtype=float)
