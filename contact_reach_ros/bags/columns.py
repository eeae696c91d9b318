"""The numbers of the messages of a topic as columns of arrays.

Ten minutes of a 1 kHz arm are two million messages. Decoding them one by one takes minutes; here batches of equal
layout are decoded together, and one whose messages differ is halved until they do not.
"""

from __future__ import annotations

import dataclasses
import struct
from abc import ABC, abstractmethod
from array import array
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.messages.cdr import (
    ARRAY_START,
    COUNT,
    HEADER,
    JOINT_STATE_FIELDS,
    NO_LAYOUT,
    PLAIN_CDR,
    STAMP_END,
    aligned,
    joint_state_layout,
)
from contact_reach_ros.timing import NANOSECONDS

Times = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Values = NDArray[np.float64]

_TIME = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
_NO_VALUES = (struct.error, ValueError, UnicodeDecodeError, MemoryError, OverflowError)
"""What decoding raises for bytes that are no message of the expected type."""


@dataclasses.dataclass(frozen=True)
class Column:
    """The n messages of one topic by time of reception, with k values each.

    Attributes
    ----------
    log_ns, publish_ns :
        (n,) times of reception and of sending, ns since the epoch.
    sequence :
        (n,) the publisher's numbers of the messages, 0 where unknown.
    stamp_ns :
        (n,) header.stamp, ns; 0 for messages without one.
    values :
        (n, k); NaN where a message lacks the value.
    refused :
        Number of messages that could not be decoded and are left out.
    back :
        Number of stamps that are older than the one before.
    """

    log_ns: Times
    publish_ns: Times
    sequence: Times
    stamp_ns: Times
    values: Values
    refused: int = 0
    back: int = 0

    def __len__(self) -> int:
        return len(self.log_ns)


class Collector(ABC):
    """Collects the messages of one topic into a column; subclasses decode them.

    Parameters
    ----------
    width :
        Number of values of a message.
    stamped :
        Whether the messages begin with a header.
    """

    def __init__(self, width: int, stamped: bool) -> None:
        self.width, self.stamped = width, stamped
        # They grow in place: to join parts at the end would take as much memory again.
        self._times, self._values = array("q"), array("d")
        self._refused = 0

    @abstractmethod
    def decode(self, rows: Bytes) -> Values | None:
        """Decode messages of one size, (n, size), into values (n, k).

        None if they differ in more than numbers, or if a single one is not of the expected type. May raise what
        decoding raises for bytes that are no message.
        """

    def __call__(self, messages: Messages) -> None:
        """Collect messages, which follow the earlier ones."""
        # Room for the stamps in the last row.
        times = np.stack([messages[name] for name in ("log_ns", "publish_ns", "sequence", "sequence")])
        times[3] = 0
        for read, values in self._read(messages["data"].tolist(), times):
            self._times.frombytes(read.T.tobytes())
            self._values.frombytes(values.tobytes())

    def column(self) -> Column:
        """Return the messages so far as a column."""
        log_ns, publish_ns, sequence, stamp_ns = np.frombuffer(self._times, np.int64).reshape(-1, 4).T
        values = np.frombuffer(self._values).reshape(-1, self.width)
        back = int((np.diff(stamp_ns) < 0).sum())
        return Column(log_ns, publish_ns, sequence, stamp_ns, values, self._refused, back)

    def _read(self, data: list[bytes], times: Times) -> Iterator[tuple[Times, Values]]:
        """Decode messages together if they have one layout, else each half by itself; refuse single ones."""
        values = self._decode_together(data, times)
        if values is not None:
            yield times, values
        elif len(data) == 1:
            self._refused += 1
        else:
            half = len(data) // 2
            yield from self._read(data[:half], times[:, :half])
            yield from self._read(data[half:], times[:, half:])

    def _decode_together(self, data: list[bytes], times: Times) -> Values | None:
        size = len(data[0])
        if size < (STAMP_END if self.stamped else HEADER) or set(map(len, data)) != {size}:
            return None
        rows = np.frombuffer(b"".join(data), np.uint8).reshape(-1, size)
        if not (rows[:, :HEADER] == np.frombuffer(PLAIN_CDR, np.uint8)).all():
            return None
        try:
            values = self.decode(rows)
        except _NO_VALUES:
            return None
        if self.stamped and values is not None:
            stamps = np.ascontiguousarray(rows[:, HEADER:STAMP_END]).view(_TIME)[:, 0]
            times[3] = stamps["sec"].astype(np.int64) * NANOSECONDS + stamps["nanosec"]
        return values


class JointStates(Collector):
    """Decodes fields of JointState messages, with joints matched by name.

    Parameters
    ----------
    fields :
        Which of position, velocity and effort; the values of a field stand side by side in a row.
    joints :
        Names in the order of the columns.
    """

    def __init__(self, fields: Sequence[str], joints: Sequence[str]) -> None:
        super().__init__(len(fields) * len(joints), stamped=True)
        self._joints = tuple(joints)
        self._fields = [JOINT_STATE_FIELDS.index(field) for field in fields]

    def decode(self, rows: Bytes) -> Values | None:
        """See `Collector.decode`."""
        first = rows[0].tobytes()
        names, counts = joint_state_layout(first)
        if counts[-1] > len(first):
            return None
        fixed = [slice(STAMP_END, counts[0]), *(slice(at, at + 4) for at in counts[:-1])]
        if not all((rows[:, part] == rows[0, part]).all() for part in fixed):
            return None
        shared = [name for name in self._joints if name in names]
        sources, into = [names.index(name) for name in shared], [self._joints.index(name) for name in shared]
        values = np.full((len(rows), len(self._fields), len(self._joints)), np.nan)
        for index, field in enumerate(self._fields):
            at = counts[field]
            start = aligned(at + COUNT.size)
            if COUNT.unpack_from(first, at)[0] == len(names):
                numbers = np.ascontiguousarray(rows[:, start : start + 8 * len(names)]).view("<f8")
                values[:, index, into] = numbers[:, sources]
        return values.reshape(len(rows), -1)


class Arrays(Collector):
    """Decodes Float64MultiArray messages without layouts; those that do not have `width` values become rows of NaN."""

    def __init__(self, width: int) -> None:
        super().__init__(width, stamped=False)
        self._head = np.frombuffer(PLAIN_CDR + NO_LAYOUT + COUNT.pack(width), np.uint8)

    def decode(self, rows: Bytes) -> Values | None:
        """See `Collector.decode`."""
        end = ARRAY_START + 8 * self.width
        if rows.shape[1] < end or not (rows[:, : len(self._head)] == self._head).all():
            return np.full((1, self.width), np.nan) if len(rows) == 1 else None
        return np.ascontiguousarray(rows[:, ARRAY_START:end]).view("<f8")
