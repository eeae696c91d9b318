"""What a node took in, and when: the log that lets a bag be re-executed to the tick.

A bag holds every message, but in real time a node may skip some, and which plan or safety state came before which
joint state is known to the node alone. So controller and observer note each message that they handle by the time at
which it was sent, which the bag has too. The notes go out in batches: a row costs less than a microsecond.

A batch is a std_msgs/Int64MultiArray without a layout: the number of its first row, counted from the start of the node,
then rows of `COLUMNS`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum

from contact_reach_ros.messages.cdr import ARRAY_COUNT, ARRAY_START, COUNT, PLAIN_CDR

COLUMNS = ("what", "sent_ns", "clock_ns", "outputs")
"""What was taken in; when it was sent, ns since the epoch, 0 for a call; the watchdogs' clock then, ns; and how many
commands or external torques the node had published before."""

BATCH = 128
"""Rows of a full batch: a tenth of a second of a 1 kHz loop."""

_SPARE = 16
"""Rows that a batch may have beyond that, until there is a good moment to publish it."""


class Taken(IntEnum):
    """What was taken in: a message of a topic, or a call."""

    JOINT_STATES = 1
    REFERENCE_POSE = 2
    REFERENCE_POSTURE = 3
    SAFETY_STATE = 4
    COMMANDS = 5
    ACTIVATE = 16
    """The lifecycle transition."""
    STOP = 17
    """The service, or another reason that lies outside of the messages."""
    RESET = 18
    """The service, as far as it was not refused for such a reason."""


TOPICS = {
    Taken.JOINT_STATES: "joint_states",
    Taken.REFERENCE_POSE: "reference/pose",
    Taken.REFERENCE_POSTURE: "reference/posture",
    Taken.SAFETY_STATE: "safety_state",
    Taken.COMMANDS: "effort_controller/commands",
}
"""Relative names of the topics."""

CODES = {name: code for code, name in TOPICS.items()}

_ROW = struct.Struct("<4q")
_FIRST = struct.Struct("<q")
_ROWS_START = ARRAY_START + _FIRST.size
_BATCH_END = _ROWS_START + BATCH * _ROW.size


class IntakeLog:
    """Gathers rows in a serialised message that is patched in place.

    To publish a batch takes longer than a row: it waits for `publish_full`, or until there is no room left.

    Attributes
    ----------
    outputs
        What the node has published so far, counted by the node.
    """

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        """`publish` gets each batch, a serialised Int64MultiArray."""
        self.outputs = 0
        self._publish = publish
        self._buffer = bytearray(_ROWS_START + (BATCH + _SPARE) * _ROW.size)
        self._buffer[: len(PLAIN_CDR)] = PLAIN_CDR
        self._at = _ROWS_START
        self._first = 0

    def add(self, what: int, sent_ns: int, clock_ns: int) -> None:
        """Note one intake, before it is handled."""
        _ROW.pack_into(self._buffer, self._at, what, sent_ns, clock_ns, self.outputs)
        self._at += _ROW.size
        if self._at == len(self._buffer):
            self.flush()

    def publish_full(self) -> None:
        """Publish a full batch, if there is one; for a moment when nothing waits to be handled."""
        if self._at >= _BATCH_END:
            self.flush()

    def flush(self) -> None:
        """Publish what has gathered."""
        rows = (self._at - _ROWS_START) // _ROW.size
        if not rows:
            return
        COUNT.pack_into(self._buffer, ARRAY_COUNT, 1 + len(COLUMNS) * rows)
        _FIRST.pack_into(self._buffer, ARRAY_START, self._first)
        self._publish(bytes(self._buffer[: self._at]))
        self._first += rows
        self._at = _ROWS_START
