"""The numbers of the messages of a topic as columns of arrays.

Ten minutes of a 1 kHz arm are two million messages. Decoding them one by one takes minutes; here batches of equal
layout are decoded together, and one whose messages differ is halved until they do not. An hour as a whole would take
gigabytes; a collector can keep what a curve needs.
"""

from __future__ import annotations

import dataclasses
import struct
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader
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
    names :
        (k,) names of the values.
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
    names: tuple[str, ...]
    values: Values
    refused: int = 0
    back: int = 0

    def __len__(self) -> int:
        return len(self.log_ns)

    @property
    def time_ns(self) -> Times:
        """(n,) stamps, or times of reception where they are zero, ns."""
        return np.where(self.stamp_ns == 0, self.log_ns, self.stamp_ns)


class Collector(ABC):
    """Collects the messages of one topic into a column; subclasses decode them.

    Parameters
    ----------
    names :
        Of the values of a message.
    stamped :
        Whether the messages begin with a header.

    Attributes
    ----------
    stride :
        If it is not 1, only messages that a curve needs are kept: of each part every so many, the last one, and those
        with the least and the greatest value of each column.
    watches :
        Are given all messages, part by part.
    """

    def __init__(self, names: tuple[str, ...], stamped: bool) -> None:
        self.names, self.stamped = names, stamped
        self.stride = 1
        self.watches: list[Callable[[Column], None]] = []
        # They grow in place: to join parts at the end would take as much memory again.
        self._times, self._values = array("q"), array("d")
        self._refused = self._back = self._last_ns = 0

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
        decoded = list(self._read(messages["data"].tolist(), times))
        if not decoded:
            return
        times = np.concatenate([times for times, _ in decoded], axis=1)
        part = self._as_column(times, np.concatenate([values for _, values in decoded]))
        self._back += int((np.diff(part.stamp_ns, prepend=self._last_ns) < 0).sum())
        self._last_ns = int(part.stamp_ns[-1])
        for watch in self.watches:
            watch(part)
        rows = self._needed(part) if self.stride > 1 else slice(None)
        self._times.frombytes(times.T[rows].tobytes())
        self._values.frombytes(part.values[rows].tobytes())

    def column(self) -> Column:
        """Return the messages so far as a column; the collector is empty afterwards."""
        times = np.frombuffer(self._times, np.int64).reshape(-1, 4)
        values = np.frombuffer(self._values).reshape(len(times), len(self.names))
        self._times, self._values = array("q"), array("d")
        return self._as_column(times.T, values)

    def _as_column(self, times: Times, values: Values) -> Column:
        log_ns, publish_ns, sequence, stamp_ns = times
        return Column(log_ns, publish_ns, sequence, stamp_ns, self.names, values, self._refused, self._back)

    def _needed(self, part: Column) -> NDArray[np.intp]:
        """Rows (n,) of a part that are kept of a thinned column."""
        kept = [np.arange(0, len(part), self.stride), np.array([len(part) - 1])]
        # The extremes of short blocks: about as many rows as the others.
        size = max(2 * part.values.shape[1], 1) * self.stride
        for start in range(0, len(part), size):
            block = part.values[start : start + size]
            kept.append(start + np.argmin(np.where(np.isnan(block), np.inf, block), axis=0))
            kept.append(start + np.argmax(np.where(np.isnan(block), -np.inf, block), axis=0))
        return np.unique(np.concatenate(kept))

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
        super().__init__(tuple(joints) * len(fields), stamped=True)
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
        super().__init__(tuple(map(str, range(width))), stamped=False)
        self._width = width
        self._head = np.frombuffer(PLAIN_CDR + NO_LAYOUT + COUNT.pack(width), np.uint8)

    def decode(self, rows: Bytes) -> Values | None:
        """See `Collector.decode`."""
        end = ARRAY_START + 8 * self._width
        if rows.shape[1] < end or not (rows[:, : len(self._head)] == self._head).all():
            return np.full((1, self._width), np.nan) if len(rows) == 1 else None
        return np.ascontiguousarray(rows[:, ARRAY_START:end]).view("<f8")


def reading(bag: BagReader, handlers: Mapping[str, Callable[[Messages], None]]) -> Iterator[int]:
    """Pass the messages of some topics to their handlers by time of reception; skip topics that the bag lacks.

    Yields the number of messages each time that some were passed, to one handler after the other.
    """
    names = [name for name in handlers if name in bag.topics]
    for batch in bag.batches(names):
        for number, name in enumerate(names):
            messages = batch[batch["topic"] == number]
            if len(messages):
                handlers[name](messages)
        yield len(batch)
