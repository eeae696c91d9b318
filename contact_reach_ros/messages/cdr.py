"""Messages as the middleware carries them (plain CDR, little-endian), and where the numbers lie in them.

ROS's own serialisation comes with rclpy, which is imported only when a whole message has to be converted: the readers
and writers of this room can be imported without it.
"""

from __future__ import annotations

import struct

from contact_reach_ros.timing import NANOSECONDS

PLAIN_CDR = b"\x00\x01\x00\x00"
"""Encapsulation header of plain CDR, little-endian. Alignment counts from its end."""

HEADER = len(PLAIN_CDR)
STAMP = struct.Struct("<iI")
STAMP_END = HEADER + STAMP.size
COUNT = struct.Struct("<I")

NO_LAYOUT = bytes(8)
"""The layout of a MultiArray that has neither dimensions nor an offset."""
ARRAY_COUNT = HEADER + len(NO_LAYOUT)
ARRAY_START = ARRAY_COUNT + 8
"""Where the 8-byte numbers of such an array begin."""

JOINT_STATE_FIELDS = ("position", "velocity", "effort")


def stamp_in(data: bytes | bytearray) -> int:
    """Stamp of a serialised message that begins with a header, ns; 0 if it is too short."""
    if len(data) < STAMP_END:
        return 0
    seconds, nanosec = STAMP.unpack_from(data, HEADER)
    return int(seconds * NANOSECONDS + nanosec)


def aligned(at: int) -> int:
    """Where the next 8-byte number stands from `at` on."""
    return HEADER + -(-(at - HEADER) // 8) * 8


def after_string(data: bytes | bytearray, at: int) -> int:
    """Where the next 4-byte number stands after the string at `at`."""
    (length,) = COUNT.unpack_from(data, at)
    return at + 4 + -(-length // 4) * 4


def after_list(data: bytes | bytearray, at: int, size: int, alignment: int = 4) -> int:
    """The end of the list at `at`, where its count stands, of elements of `size` bytes."""
    (count,) = COUNT.unpack_from(data, at)
    start = aligned(at + 4) if count and alignment == 8 else at + 4
    return start + size * count


def text_at(data: bytes | bytearray, at: int) -> str:
    """The string at `at`, where its length stands."""
    (length,) = COUNT.unpack_from(data, at)
    return bytes(data[at + 4 : at + 3 + length]).decode()


def joint_state_names(data: bytes | bytearray) -> tuple[str, ...]:
    """The field name of a serialised JointState."""
    at = after_string(data, STAMP_END)
    (count,) = COUNT.unpack_from(data, at)
    at += 4
    names = []
    for _ in range(count):
        names.append(text_at(data, at))
        at = after_string(data, at)
    return tuple(names)


def joint_state_counts(data: bytes | bytearray) -> list[int]:
    """Where in a serialised JointState the numbers of values of its three fields stand, and its end."""
    at = after_string(data, STAMP_END)
    (names,) = COUNT.unpack_from(data, at)
    at += 4
    for _ in range(names):
        at = after_string(data, at)
    counts = []
    for _ in JOINT_STATE_FIELDS:
        counts.append(at)
        (count,) = COUNT.unpack_from(data, at)
        at = aligned(at + 4) + 8 * count if count else at + 4
    return [*counts, at]


def joint_state_starts(data: bytes | bytearray) -> list[int]:
    """Where in a serialised JointState the values of its three fields begin, if there are any."""
    return [aligned(at + 4) for at in joint_state_counts(data)[:-1]]
