"""Reading much of a bag at once: whole chunks of messages, and their numbers as columns of an array.

Ten minutes of a 1 kHz arm are two million messages. Taking them apart one by one takes minutes; here only those that
look unlike the one before are decoded in the usual way.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from contact_reach_ros.cdr import (
    ARRAY_COUNT,
    ARRAY_START,
    COUNT,
    HEADER,
    JOINT_STATE_FIELDS,
    NO_LAYOUT,
    PLAIN_CDR,
    STAMP_END,
    joint_state_counts,
    joint_state_names,
    joint_state_starts,
)
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.mcap_file import MAGIC, McapFile
from contact_reach_ros.units import NANOSECONDS

Times = NDArray[np.int64]

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_MESSAGE_CODE, _CHUNK_CODE, _DATA_END_CODE = 0x05, 0x06, 0x0F


@dataclasses.dataclass(frozen=True)
class Block:
    """Messages of one topic in one chunk of a file.

    Attributes
    ----------
    log_ns, publish_ns, sequence :
        (n,) reception and sending, ns since the epoch, and the number that the publisher gave.
    chunk :
        The bytes that the messages are in.
    start, size :
        (n,) where each message begins and how long it is, its CDR header included.
    """

    log_ns: Times
    publish_ns: Times
    sequence: Times
    chunk: bytes
    start: Times
    size: Times

    def __len__(self) -> int:
        return len(self.start)

    def data(self, index: int) -> bytes:
        """One message."""
        start = int(self.start[index])
        return self.chunk[start : start + int(self.size[index])]

    def alike(self) -> NDArray[np.uint8] | None:
        """The messages as rows (n, size) if they are all of the same size, else None."""
        size = int(self.size[0])
        if (self.size != size).any():
            return None
        return np.frombuffer(self.chunk, np.uint8)[self.start[:, None] + np.arange(size)]


def blocks(bag: BagReader, topics: Collection[str]) -> Iterator[tuple[str, Block]]:
    """The messages of some topics, chunk by chunk, in the order in which they were written.

    Those that are missing in the bag are passed over; a file that is cut is read as far as it goes.
    """
    for file in bag.files:
        wanted = {number: channel.topic for number, channel in file.contents.channels.items()}
        wanted = {number: topic for number, topic in wanted.items() if topic in topics}
        for chunk in _chunks(file):
            yield from _of_chunk(chunk, wanted)


def _of_chunk(chunk: bytes, wanted: Mapping[int, str]) -> Iterator[tuple[str, Block]]:
    found: defaultdict[int, list[tuple[int, int, int, int, int]]] = defaultdict(list)
    at, end = 0, len(chunk)
    unpack_record, unpack_message = _RECORD.unpack_from, _MESSAGE.unpack_from
    while at + _RECORD.size <= end:
        code, length = unpack_record(chunk, at)
        at += _RECORD.size
        if code == _MESSAGE_CODE:
            channel, sequence, log_ns, publish_ns = unpack_message(chunk, at)
            if channel in wanted:
                start = at + _MESSAGE.size
                found[channel].append((log_ns, publish_ns, sequence, start, length - _MESSAGE.size))
        at += length
    for channel, rows in found.items():
        columns = np.array(rows, dtype=np.int64).T
        yield wanted[channel], Block(columns[0], columns[1], columns[2], chunk, columns[3], columns[4])


def _chunks(file: McapFile) -> Iterator[bytes]:
    """The uncompressed chunks; messages outside of chunks make up one of their own."""
    loose = bytearray()
    with file.path.open("rb") as stream:
        stream.seek(len(MAGIC))
        while True:
            head = stream.read(_RECORD.size)
            if len(head) < _RECORD.size:
                break
            code, length = _RECORD.unpack(head)
            if code == _DATA_END_CODE:
                break
            if code not in (_CHUNK_CODE, _MESSAGE_CODE):
                stream.seek(length, 1)
                continue
            content = stream.read(length) if length < file.size else b""
            if len(content) < length or not length:
                break
            if code == _MESSAGE_CODE:
                loose += head + content
                continue
            chunk = _uncompressed(content)
            if chunk is None:
                break
            yield chunk
    if loose:
        yield bytes(loose)


def _uncompressed(content: bytes) -> bytes | None:
    """The records of a chunk; None if it is damaged."""
    try:
        *_, size, checksum, name_length = _CHUNK.unpack_from(content)
        at = _CHUNK.size + name_length
        compression = content[_CHUNK.size : at].decode()
        (length,) = _LENGTH.unpack_from(content, at)
        records = content[at + _LENGTH.size : at + _LENGTH.size + length]
        if compression == "zstd":
            records = zstandard.ZstdDecompressor().decompress(records, max_output_size=size)
        elif compression == "lz4":
            records = lz4.frame.decompress(records)
        elif compression:
            return None
    except (struct.error, UnicodeDecodeError, zstandard.ZstdError, RuntimeError, MemoryError):
        return None
    return None if len(records) != size or (checksum and zlib.crc32(records) != checksum) else records


@dataclasses.dataclass
class Column:
    """Messages of one topic as arrays.

    Attributes
    ----------
    log_ns, publish_ns, sequence :
        As in `Block`, for all messages in the order of the file.
    stamp_ns :
        (n,) header.stamp, ns; 0 for messages without one.
    values :
        (n, k); NaN where a message had no such value.
    """

    log_ns: Times
    publish_ns: Times
    sequence: Times
    stamp_ns: Times
    values: NDArray[Any]

    def __len__(self) -> int:
        return len(self.log_ns)


class _Collector:
    """Gathers the parts of a column."""

    width: int
    dtype: Any = float

    def __init__(self) -> None:
        self._parts: list[tuple[Times, ...]] = []
        self._values: list[NDArray[Any]] = []
        self.refused = 0
        """Messages that are none of their type."""

    def add(self, block: Block) -> None:
        """Take the messages of a block."""
        stamps, values, good = self._read(block)
        self.refused += len(block) - int(good.sum())
        columns = (block.log_ns, block.publish_ns, block.sequence, stamps)
        self._parts.append(tuple(column[good] for column in columns))
        self._values.append(values[good])

    def column(self) -> Column:
        """All that came."""
        if not self._parts:
            nothing = np.zeros(0, np.int64)
            return Column(nothing, nothing, nothing, nothing, np.zeros((0, self.width), self.dtype))
        log, publish, sequence, stamps = (np.concatenate(parts) for parts in zip(*self._parts, strict=True))
        width = max(values.shape[1] for values in self._values)
        padded = [
            np.pad(values, ((0, 0), (0, width - values.shape[1])), constant_values=np.nan)
            if values.shape[1] < width
            else values
            for values in self._values
        ]
        values = np.concatenate(padded)
        self._parts, self._values = [], []
        if (np.diff(log) < 0).any():
            order = np.argsort(log, kind="stable")
            return Column(log[order], publish[order], sequence[order], stamps[order], values[order])
        return Column(log, publish, sequence, stamps, values)

    def _read(self, block: Block) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        raise NotImplementedError


class JointStates(_Collector):
    """Fields of JointState messages, mapped by name.

    Parameters
    ----------
    fields
        Which of position, velocity and effort; their values stand side by side in the rows.
    names
        Joints in the order of the columns; those that are found, in the order of their appearance, when None.
    """

    def __init__(self, fields: Sequence[str], names: Sequence[str] | None = None) -> None:
        super().__init__()
        self._fields = [JOINT_STATE_FIELDS.index(field) for field in fields]
        self._open = names is None
        self.names = list(names or ())

    @property
    def width(self) -> int:  # type: ignore[override]
        """Columns in a row."""
        return len(self._fields) * len(self.names)

    def _read(self, block: Block) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        rows = block.alike()
        if rows is not None and len(rows):
            first = block.data(0)
            layout = self._layout(first)
            if layout is not None:
                end, starts, sources, into = layout
                # Names, and the numbers of values, must be those of the first message.
                fixed = [slice(0, HEADER), slice(STAMP_END, end)]
                fixed += [slice(at, at + 4) for at in joint_state_counts(first)[:-1]]
                if all((rows[:, part] == rows[0, part]).all() for part in fixed):
                    return self._from_rows(rows, starts, sources, into, len(joint_state_names(first)))
        return self._one_by_one(block)

    def _from_rows(
        self, rows: NDArray[np.uint8], starts: list[int | None], sources: list[int], into: list[int], count: int
    ) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        values = np.full((len(rows), self.width), np.nan)
        for place, field in enumerate(self._fields):
            start = starts[field]
            if start is not None:
                numbers = np.ascontiguousarray(rows[:, start : start + 8 * count]).view("<f8")
                values[:, [place * len(self.names) + column for column in into]] = numbers[:, sources]
        return _stamps(rows), values, np.ones(len(rows), bool)

    def _one_by_one(self, block: Block) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        parts = []
        for index in range(len(block)):
            data = block.data(index)
            layout = self._layout(data)
            if layout is None:
                parts.append(None)
                continue
            _, starts, sources, into = layout
            row = np.frombuffer(data, np.uint8)[None]
            parts.append(self._from_rows(row, starts, sources, into, len(joint_state_names(data))))
        width = self.width
        stamps, values = np.zeros(len(block), np.int64), np.full((len(block), width), np.nan)
        for index, part in enumerate(parts):
            if part is not None:
                stamps[index] = part[0][0]
                values[index, : part[1].shape[1]] = part[1][0]
        return stamps, values, np.array([part is not None for part in parts])

    def _layout(self, data: bytes) -> tuple[int, list[int | None], list[int], list[int]] | None:
        """End of the names, start of each field (None without values), and which of the names go to which columns."""
        try:
            names = joint_state_names(data)
            counts = joint_state_counts(data)
            if not data.startswith(PLAIN_CDR) or counts[-1] > len(data):
                return None
            numbers = [COUNT.unpack_from(data, at)[0] for at in counts[:-1]]
        except (struct.error, UnicodeDecodeError, MemoryError, OverflowError):
            return None
        if self._open:
            self.names += [name for name in dict.fromkeys(names) if name not in self.names]
        shared = [name for name in self.names if name in names]
        starts = [
            start if number == len(names) else None
            for start, number in zip(joint_state_starts(data), numbers, strict=True)
        ]
        sources, into = [names.index(name) for name in shared], [self.names.index(name) for name in shared]
        return counts[0], starts, sources, into


class Arrays(_Collector):
    """Values of Float64MultiArray or Int64MultiArray messages that have `width` of them; others make a row of NaN."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width

    def _read(self, block: Block) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        stamps, good = np.zeros(len(block), np.int64), np.ones(len(block), bool)
        size, head = ARRAY_START + 8 * self.width, PLAIN_CDR + NO_LAYOUT + COUNT.pack(self.width)
        rows = block.alike()
        if rows is not None and rows.shape[1] >= size:
            expected = np.frombuffer(head, np.uint8)
            if (rows[:, : len(head)] == expected).all():
                return stamps, np.ascontiguousarray(rows[:, ARRAY_START:size]).view("<f8"), good
        values = np.full((len(block), self.width), np.nan)
        for index in range(len(block)):
            numbers = whole_array(block.data(index), "<f8")
            if len(numbers) == self.width:
                values[index] = numbers
        return stamps, values, good


class Stamps(_Collector):
    """The stamps alone, of messages that begin with a header."""

    width = 0

    def _read(self, block: Block) -> tuple[Times, NDArray[Any], NDArray[np.bool_]]:
        good = block.size >= STAMP_END
        data = np.frombuffer(block.chunk, np.uint8)
        start = np.where(good, block.start, 0)
        return _stamps(data[start[:, None] + np.arange(STAMP_END)]), np.zeros((len(block), 0)), good


def whole_array(data: bytes, dtype: str) -> NDArray[Any]:
    """The 8-byte numbers of one MultiArray without a layout; none if it is no such message."""
    if not data.startswith(PLAIN_CDR + NO_LAYOUT) or len(data) < ARRAY_START:
        return np.zeros(0, dtype)
    (count,) = COUNT.unpack_from(data, ARRAY_COUNT)
    if len(data) < ARRAY_START + 8 * count:
        return np.zeros(0, dtype)
    return np.frombuffer(data, dtype, count, ARRAY_START)


def _stamps(rows: NDArray[np.uint8]) -> Times:
    words = np.ascontiguousarray(rows[:, HEADER:STAMP_END]).view("<u4").astype(np.int64)
    return words[:, 0] * NANOSECONDS + words[:, 1]
