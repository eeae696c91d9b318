"""Messages as the middleware carries them (plain CDR, little-endian), and where the numbers lie in them.

Of ROS it needs nothing, so that bags are read without it.
"""

from __future__ import annotations

import struct
from typing import Any

from contact_reach_ros.errors import InputError
from contact_reach_ros.timing import NANOSECONDS

PLAIN_CDR = b"\x00\x01\x00\x00"
"""Encapsulation header of plain CDR, little-endian. Alignment counts from its end."""

HEADER = len(PLAIN_CDR)
STAMP = struct.Struct("<iI")
STAMP_END = HEADER + STAMP.size
COUNT = struct.Struct("<I")

NO_LAYOUT = bytes(8)
"""The layout of a MultiArray that has neither dimensions nor an offset."""
ARRAY_START = HEADER + len(NO_LAYOUT) + 8
"""Where the 8-byte numbers of such an array begin."""

JOINT_STATE_FIELDS = ("position", "velocity", "effort")


def stamp_in(data: bytes | bytearray) -> int:
    """Stamp of a serialised message that begins with a header, ns; 0 if it is too short."""
    if len(data) < STAMP_END:
        return 0
    seconds, nanosec = STAMP.unpack_from(data, HEADER)
    return int(seconds * NANOSECONDS + nanosec)


def aligned(at: int, size: int = 8) -> int:
    """Where the next number of `size` bytes stands from `at` on."""
    return HEADER + -(-(at - HEADER) // size) * size


class Cursor:
    """Reads the fields of a serialised message one after the other.

    Past the end of the message it raises `struct.error` or `ValueError`; `no_message` makes an `InputError` of them.
    """

    def __init__(self, data: bytes | bytearray, at: int = HEADER) -> None:
        """`at`: place of the first field.

        Raises `ValueError` if the message is in another encoding.
        """
        if data[:2] != PLAIN_CDR[:2]:
            raise ValueError("not in plain CDR, little-endian")
        self.data = data
        self.at = at

    def numbers(self, layout: struct.Struct, size: int = 4) -> tuple[Any, ...]:
        """Numbers of which the first has `size` bytes."""
        start = aligned(self.at, size)
        self.at = start + layout.size
        return layout.unpack_from(self.data, start)

    def count(self) -> int:
        """The number of elements of a list, or of bytes of a text."""
        return int(self.numbers(COUNT)[0])

    def text(self) -> str:
        """A text."""
        start, end = self.skip(1)
        return bytes(self.data[start : end - 1]).decode()

    def skip(self, size: int, alignment: int = 1) -> tuple[int, int]:
        """A list, or a text, of elements of `size` bytes: the places where they begin and end."""
        count = self.count()
        start = aligned(self.at, alignment) if count else self.at
        self.at = start + size * count
        if self.at > len(self.data):
            raise ValueError("cut off")
        return start, self.at


def no_message(data: bytes, kind: str, topic: str, error: Exception) -> InputError:
    """The refusal of bytes that are no message of a kind, such as JointState."""
    return InputError(f"{topic}: {len(data)} bytes that are no {kind}; expected a serialised {kind} ({error})")


def joint_state_layout(data: bytes | bytearray) -> tuple[tuple[str, ...], list[int]]:
    """The names in a serialised JointState; where the numbers of values of its three fields stand, and its end."""
    cursor, counts = Cursor(data, STAMP_END), []
    cursor.skip(1)  # frame_id
    names = tuple(cursor.text() for _ in range(cursor.count()))
    for _ in JOINT_STATE_FIELDS:
        counts.append(aligned(cursor.at, COUNT.size))
        cursor.skip(8, 8)
    return names, [*counts, cursor.at]
