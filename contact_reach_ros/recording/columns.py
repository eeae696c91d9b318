"""Reading much of a bag at once: the numbers of its messages as columns of arrays.

Ten minutes of a 1 kHz arm are two million messages. Taking them apart one by one takes minutes; here only those that
do not look like their neighbours are.
"""

from __future__ import annotations

import dataclasses
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    joint_state_counts,
    joint_state_names,
    joint_state_starts,
)
from contact_reach_ros.recording.bag_reader import BagReader, RawMessage
from contact_reach_ros.recording.mcap_chunks import Block
from contact_reach_ros.recording.mcap_file import McapFile
from contact_reach_ros.units import NANOSECONDS

Times = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_BATCH = 4096


@dataclasses.dataclass(frozen=True)
class Column:
    """The messages of one topic, in the order of their reception.

    Attributes
    ----------
    log_ns, publish_ns :
        (n,) reception and sending, ns since the epoch.
    sequence :
        (n,) numbers that the publisher gave, 0 where they are not known.
    stamp_ns :
        (n,) header.stamp, ns; 0 for messages without one.
    names :
        What the k columns are.
    values :
        (n, k); NaN where a message had no such value.
    refused :
        Messages that are none of their type, which are left out.
    """

    log_ns: Times
    publish_ns: Times
    sequence: Times
    stamp_ns: Times
    names: tuple[str, ...]
    values: NDArray[np.float64]
    refused: int = 0

    def __len__(self) -> int:
        return len(self.log_ns)


class Collector(ABC):
    """Gathers the messages of one topic in a column. Subclasses say how many of them are read at once."""

    stamped = True
    """Whether the messages begin with a header."""

    def __init__(self) -> None:
        self._waiting: list[RawMessage] = []
        self._times: list[NDArray[np.int64]] = []
        self._values: list[NDArray[np.float64]] = []
        self._refused = 0

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of the columns."""

    @abstractmethod
    def alike(self, rows: Bytes) -> NDArray[np.float64] | None:
        """Values (n, k) of messages of one size (n, size) that look alike except for numbers; None if they do not."""

    @abstractmethod
    def single(self, data: bytes) -> NDArray[np.float64] | None:
        """Values (k,) of one message; None if it is none."""

    def add(self, message: RawMessage) -> None:
        """Take a message."""
        self._waiting.append(message)
        if len(self._waiting) == _BATCH:
            self._read_waiting()

    def add_block(self, block: Block) -> None:
        """Take the messages of a block."""
        # Room for the stamps in the last row.
        times = np.stack([block.log_ns, block.publish_ns, block.sequence, np.zeros_like(block.log_ns)])
        size = int(block.sizes[0])
        if size >= HEADER and (block.sizes == size).all():
            rows = np.frombuffer(block.content, np.uint8)[block.starts[:, None] + np.arange(size)]
            if self._read_rows(rows, times):
                return
        self._read_each([block.data(row) for row in range(len(block.starts))], times)

    def column(self) -> Column:
        """All that came."""
        self._read_waiting()
        width, count = len(self.names), sum(part.shape[1] for part in self._times)
        times, values = np.empty((4, count), np.int64), np.full((count, width), np.nan)
        at = 0
        # Part by part, each forgotten at once: together they may be most of the memory.
        self._times.reverse()
        self._values.reverse()
        while self._times:
            part, numbers = self._times.pop(), self._values.pop()
            end = at + part.shape[1]
            times[:, at:end] = part
            values[at:end, : numbers.shape[1]] = numbers
            at = end
        if (np.diff(times[0]) < 0).any():
            order = np.argsort(times[0], kind="stable")
            times, values = times[:, order], values[order]
        log_ns, publish_ns, sequence, stamp_ns = times
        return Column(log_ns, publish_ns, sequence, stamp_ns, self.names, values, self._refused)

    def _read_waiting(self) -> None:
        messages, self._waiting = self._waiting, []
        if messages:
            self.add_block(Block.of([(m.log_time_ns, m.publish_time_ns, m.sequence, m.data) for m in messages]))

    def _read_rows(self, rows: Bytes, times: Times) -> bool:
        """Read messages of one size, if they look alike."""
        if self.stamped and rows.shape[1] < STAMP_END:
            return False
        values = self.alike(rows)
        if values is None:
            return False
        if self.stamped:
            words = np.ascontiguousarray(rows[:, HEADER:STAMP_END]).view("<u4").astype(np.int64)
            times[3] = words[:, 0] * NANOSECONDS + words[:, 1]
        self._times.append(times)
        self._values.append(values)
        return True

    def _read_each(self, messages: list[bytes], times: Times) -> None:
        read = [self._read_single(data) for data in messages]
        good = np.array([values is not None for values in read])
        self._refused += len(messages) - int(good.sum())
        if self.stamped:
            times[3] = [_stamp_ns(data) for data in messages]
        width = len(self.names)
        rows = [_widened(values[None], width) for values in read if values is not None]
        self._times.append(times[:, good])
        self._values.append(np.concatenate([np.zeros((0, width)), *rows]))

    def _read_single(self, data: bytes) -> NDArray[np.float64] | None:
        if not data.startswith(PLAIN_CDR) or (self.stamped and len(data) < STAMP_END):
            return None
        try:
            return self.single(data)
        except (struct.error, ValueError, UnicodeDecodeError, MemoryError, OverflowError):
            return None


class JointStates(Collector):
    """Fields of JointState messages, mapped by name.

    Parameters
    ----------
    fields
        Which of position, velocity and effort; their values stand side by side in the rows.
    joints
        In the order of the columns; those that are found, in the order of their appearance, when None.
    """

    def __init__(self, fields: Sequence[str], joints: Sequence[str] | None = None) -> None:
        super().__init__()
        self._fields = [JOINT_STATE_FIELDS.index(field) for field in fields]
        self._open = joints is None
        self._joints = list(joints or ())
        if self._open and len(fields) > 1:
            raise ValueError("columns of several fields can only be kept apart for joints that are known beforehand")

    @property
    def names(self) -> tuple[str, ...]:
        """Joints, once for each field."""
        return tuple(self._joints * len(self._fields))

    def alike(self, rows: Bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        first = rows[0].tobytes()
        if not first.startswith(PLAIN_CDR):
            return None
        try:
            counts = joint_state_counts(first)
            if counts[-1] > len(first):
                return None
            fixed = [slice(0, HEADER), slice(STAMP_END, counts[0]), *(slice(at, at + 4) for at in counts[:-1])]
            if not all((rows[:, part] == rows[0, part]).all() for part in fixed):
                return None
            return self._values_of(rows, first)
        except (struct.error, ValueError, UnicodeDecodeError, MemoryError, OverflowError):
            return None

    def single(self, data: bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        if joint_state_counts(data)[-1] > len(data):
            return None
        return self._values_of(np.frombuffer(data, np.uint8)[None], data)[0]

    def _values_of(self, rows: Bytes, first: bytes) -> NDArray[np.float64]:
        names = joint_state_names(first)
        if self._open:
            self._joints += [name for name in dict.fromkeys(names) if name not in self._joints]
        shared = [name for name in self._joints if name in names]
        sources, into = [names.index(name) for name in shared], [self._joints.index(name) for name in shared]
        values = np.full((len(rows), len(self.names)), np.nan)
        places = list(zip(joint_state_starts(first), joint_state_counts(first), strict=False))
        for index, field in enumerate(self._fields):
            start, at = places[field]
            if COUNT.unpack_from(first, at)[0] == len(names):
                numbers = np.ascontiguousarray(rows[:, start : start + 8 * len(names)]).view("<f8")
                values[:, [index * len(self._joints) + column for column in into]] = numbers[:, sources]
        return values


class Arrays(Collector):
    """Float64MultiArray messages with `width` values, without layouts; those with another number make a row of NaN."""

    stamped = False

    def __init__(self, width: int) -> None:
        super().__init__()
        self._width = width
        self._head = np.frombuffer(PLAIN_CDR + NO_LAYOUT + COUNT.pack(width), np.uint8)

    @property
    def names(self) -> tuple[str, ...]:
        """Numbers."""
        return tuple(map(str, range(self._width)))

    def alike(self, rows: Bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        end = ARRAY_START + 8 * self._width
        if rows.shape[1] < end or not (rows[:, : len(self._head)] == self._head).all():
            return None
        return np.ascontiguousarray(rows[:, ARRAY_START:end]).view("<f8")

    def single(self, data: bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        numbers = array_numbers(data, "<f8")
        return numbers if len(numbers) == self._width else np.full(self._width, np.nan)


class Stamps(Collector):
    """The stamps alone, of messages that begin with a header."""

    @property
    def names(self) -> tuple[str, ...]:
        """None."""
        return ()

    def alike(self, rows: Bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        plain = (rows[:, :HEADER] == np.frombuffer(PLAIN_CDR, np.uint8)).all()
        return np.zeros((len(rows), 0)) if plain else None

    def single(self, data: bytes) -> NDArray[np.float64] | None:
        """As the base class says."""
        return np.zeros(0)


def array_numbers(data: bytes, dtype: str) -> NDArray[Any]:
    """The 8-byte numbers of one MultiArray without a layout; none if it is no such message."""
    if not data.startswith(PLAIN_CDR + NO_LAYOUT) or len(data) < ARRAY_START:
        return np.zeros(0, dtype)
    (count,) = COUNT.unpack_from(data, ARRAY_COUNT)
    if len(data) < ARRAY_START + 8 * count:
        return np.zeros(0, dtype)
    return np.frombuffer(data, dtype, count, ARRAY_START)


def read_raw(bag: BagReader, handlers: Mapping[str, Collector | Callable[[RawMessage], None]]) -> None:
    """Hand the messages of some topics to their handlers, in one pass; topics that the bag lacks are passed over.

    Those of one topic come in the order of the file, in that of their reception within each of its chunks.
    """
    wanted = {topic: handler for topic, handler in handlers.items() if topic in bag.topics()}
    if all(file.contents.indexed for file in bag.files):
        for file in bag.files:
            _read_indexed(bag, file, wanted)
        return
    for message in bag.raw_messages(wanted):
        handler = wanted[message.topic]
        if isinstance(handler, Collector):
            handler.add(message)
        else:
            handler(message)


def _read_indexed(
    bag: BagReader, file: McapFile, handlers: Mapping[str, Collector | Callable[[RawMessage], None]]
) -> None:
    channels = {
        number: (channel.topic, handlers[channel.topic])
        for number, channel in file.contents.channels.items()
        if channel.topic in handlers
    }
    for blocks in file.blocks(set(channels)):
        for number, block in blocks.items():
            topic, handler = channels[number]
            if isinstance(handler, Collector):
                handler.add_block(block)
                continue
            type_name = bag.topics()[topic].type
            for row in np.argsort(block.log_ns, kind="stable").tolist():
                received, sent, sequence = (int(column[row]) for column in block[1:4])
                handler(RawMessage(topic, type_name, received, sent, block.data(row), sequence))


def _stamp_ns(data: bytes) -> int:
    if len(data) < STAMP_END:
        return 0
    seconds, nanosec = STAMP.unpack_from(data, HEADER)
    return seconds * NANOSECONDS + nanosec


def _widened(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Rows filled up with NaN to a width."""
    if values.shape[1] == width:
        return values
    return np.pad(values, ((0, 0), (0, width - values.shape[1])), constant_values=np.nan)
