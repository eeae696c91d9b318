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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.messages.cdr import ARRAY_START, COUNT, NO_LAYOUT, PLAIN_CDR

COLUMNS = ("what", "sent_ns", "clock_ns", "outputs")
"""What was taken in; when it was sent, ns since the epoch, 0 for a call; the watchdogs' clock then, ns; and how many
commands or external torques the node had published before."""

BATCH = 128
"""Rows of a full batch: a tenth of a second of a 1 kHz loop."""


class Taken(IntEnum):
    """What was taken in: a message of a topic, or a call."""

    JOINT_STATES = 1
    REFERENCE_POSE = 2
    REFERENCE_POSTURE = 3
    SAFETY_STATE = 4
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
}
"""Relative names of the topics."""

CODES = {name: code for code, name in TOPICS.items()}


def read_batch(message: Any) -> tuple[int, NDArray[np.int64]]:
    """The number of the first row in a batch, and its rows (n, 4); no rows if the message is no batch."""
    numbers = np.asarray(message.data)
    if len(numbers) % len(COLUMNS) != 1:
        return 0, np.zeros((0, len(COLUMNS)), np.int64)
    return int(numbers[0]), numbers[1:].reshape(-1, len(COLUMNS))


class IntakeLog:
    """Gathers rows; to publish a batch takes longer than a row, and waits for `publish_full`.

    Attributes
    ----------
    outputs
        What the node has published so far, counted by the node.
    """

    def __init__(self, publish: Callable[[bytes], None]) -> None:
        """`publish` gets each batch, a serialised Int64MultiArray."""
        self.outputs = 0
        self._publish = publish
        self._numbers: list[int] = []
        self._first = 0

    def add(self, what: int, sent_ns: int, clock_ns: int) -> None:
        """Note one intake, before it is handled."""
        self._numbers += (what, sent_ns, clock_ns, self.outputs)

    def publish_full(self) -> None:
        """Publish a full batch, if there is one; for a moment when nothing waits to be handled."""
        if len(self._numbers) >= BATCH * len(COLUMNS):
            self.flush()

    def flush(self) -> None:
        """Publish what has gathered."""
        if not self._numbers:
            return
        numbers = (self._first, *self._numbers)
        head = (PLAIN_CDR + NO_LAYOUT + COUNT.pack(len(numbers))).ljust(ARRAY_START, b"\0")
        self._publish(head + struct.pack(f"<{len(numbers)}q", *numbers))
        self._first += len(self._numbers) // len(COLUMNS)
        self._numbers.clear()
