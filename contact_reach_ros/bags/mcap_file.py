"""One mcap file: its contents, and its messages by time of reception.

The `mcap` package reads the records. A file is opened by its index; one without a complete index, such as that of a
recorder that was killed or whose disk was full, is read up to its end, or to where it is cut. Chunks are read one by
one, since `SeekingReader.iter_messages` gives up the whole file for a damaged one.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError

_DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError, OSError)
"""What the libraries raise where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text, or a
length that nothing can have."""
_LATEST_NS = 2**63 - 1
"""Last time that ROS can express."""
_RECORD_HEAD, _MESSAGE_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Beginnings of a record, opcode and length, and of a message: channel, sequence, times of reception and sending."""
_INDEX_HEAD, _INDEX_ENTRY = struct.Struct("<BQHI"), np.dtype([("time", "<u8"), ("position", "<u8")])
"""Beginning of a message index: opcode, length, channel, bytes of the entries that follow."""
_PART_BYTES = 2**20
"""Messages outside of chunks are read in portions of this size."""
_RECEPTION = attrgetter("log_time")


class _Part(NamedTuple):
    """Messages that are read together, from byte `start` to `end`: mostly a chunk.

    They were received from `first_ns` to `last_ns`. `channels` are the numbers of their channels, with the positions of
    the message indexes: 0 where there is none.
    """

    first_ns: int
    last_ns: int
    start: int
    end: int
    channels: Mapping[int, int]


class McapFile:
    """A recording in one mcap file; raises `BagError` if the file is missing, empty, or no mcap file.

    Attributes
    ----------
    schemas, channels :
        By their number in the file.
    message_counts :
        Messages by channel number.
    span_ns :
        Times of reception of the first and of the last message, ns since the epoch; None without messages.
    metadata :
        Metadata records by name; the last one of a name counts.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.message_counts: Counter[int] = Counter()
        self.span_ns: tuple[int, int] | None = None
        self.metadata: dict[str, dict[str, str]] = {}
        self._parts: list[_Part] = []
        self._cut_at: int | None = None
        self._damaged: set[int] = set()
        self._untimely: Counter[int] = Counter()
        try:
            with path.open("rb") as stream:
                beginning = stream.read(len(MCAP0_MAGIC))
            self._size = path.stat().st_size
        except OSError as error:
            raise BagError(f"{path}: cannot be opened: {error.strerror}") from error
        if not beginning:
            raise BagError(f"{path}: is empty; the recording stopped before anything was written")
        if beginning != MCAP0_MAGIC:
            raise BagError(
                f"{path}: is no mcap file (its first bytes are {beginning.hex(' ')}); "
                "`ros2 bag convert` can convert other recordings"
            )
        if not self._open_by_index():
            self._scan()
        self._parts.sort(key=lambda part: (part.first_ns, part.start))
        # The next request often lies close by: the viewer reads topic by topic and moment by moment.
        self._read_cached = lru_cache(4)(self._read)

    def notes(self) -> Iterator[str]:
        """Yield a sentence about each kind of defect found so far."""
        name = self.path.name
        if self._cut_at is not None:
            yield f"{name} is cut or damaged: readable up to byte {self._cut_at} of {self._size}"
        if self._damaged:
            yield f"{name}: {len(self._damaged)} chunks are damaged, their messages are left out"
        if self._untimely.total():
            yield f"{name}: {self._untimely.total()} messages with a time after the year 2262 are left out"

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[tuple[str, Message]]:
        """Yield topic and message by time of reception, from a time in ns since the epoch on.

        Messages are held back only as long as a later part may have older ones. Damaged chunks are left out.
        """
        names = {number: channel.topic for number, channel in self.channels.items() if channel.topic in topics}
        waiting: list[Message] = []
        for part in self._parts:
            if names.keys().isdisjoint(part.channels) or part.last_ns < start_ns:
                continue
            ready = bisect_left(waiting, part.first_ns, key=_RECEPTION)
            yield from ((names[message.channel_id], message) for message in waiting[:ready])
            read = self._read_cached(part.start, part.end)
            found = [message for message in read if message.channel_id in names and message.log_time >= start_ns]
            # Stable: messages of the same time stay in the order of the file.
            waiting = sorted(waiting[ready:] + found, key=_RECEPTION)
        yield from ((names[message.channel_id], message) for message in waiting)

    def reception_times(self) -> dict[int, NDArray[np.int64]]:
        """Return times of reception, (n,) in ns since the epoch, by channel number, in the order of the file."""
        parts = sorted(self._parts, key=lambda part: part.start)
        times: dict[int, list[NDArray[np.int64]]] = {number: [np.zeros(0, np.int64)] for number in self.channels}
        with self.path.open("rb") as stream:
            for part in parts:
                try:
                    found = {number: _indexed_times(stream, number, at) for number, at in part.channels.items()}
                except _DAMAGE:
                    read = self._read(part.start, part.end)
                    found = {
                        n: np.array([m.log_time for m in read if m.channel_id == n], np.int64) for n in part.channels
                    }
                for number, values in found.items():
                    times[number].append(values)
        return {number: np.concatenate(parts) for number, parts in times.items()}

    def _open_by_index(self) -> bool:
        """Take contents and chunks from the summary; returns False if it is missing, damaged or incomplete."""
        try:
            with self.path.open("rb") as stream:
                reader = SeekingReader(stream)
                summary = reader.get_summary()
                if summary is None or summary.statistics is None or not _is_complete(summary):
                    return False
                self.metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        except _DAMAGE:
            return False
        self.schemas, self.channels = summary.schemas, summary.channels
        statistics = summary.statistics
        self.message_counts.update(statistics.channel_message_counts)
        if statistics.message_count:
            self.span_ns = statistics.message_start_time, statistics.message_end_time
        for chunk in summary.chunk_indexes:
            start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
            times = chunk.message_start_time, chunk.message_end_time
            self._parts.append(_Part(*times, start, end, chunk.message_index_offsets))
        return True

    def _scan(self) -> None:
        """Go through the file to its end, or to where it is cut."""
        start = end = len(MCAP0_MAGIC)
        with self.path.open("rb") as stream:
            try:
                for record in self._records(stream):
                    end = stream.tell()
                    if isinstance(record, Chunk) or end - start > _PART_BYTES:
                        self._add_part(start, end)
                        start = end
            except _DAMAGE:
                self._cut_at = end
        self._add_part(start, end)

    def _add_part(self, start: int, end: int) -> None:
        records = self._unpack(start, end)
        for record in records:
            if isinstance(record, Metadata):
                self.metadata[record.name] = record.metadata
            elif isinstance(record, Schema):
                self.schemas[record.id] = record
            elif isinstance(record, Channel):
                self.channels[record.id] = record
        messages = self._known_messages(start, records)
        if messages:
            times = [message.log_time for message in messages]
            first_ns, last_ns = min(times), max(times)
            counts = Counter(message.channel_id for message in messages)
            self._parts.append(_Part(first_ns, last_ns, start, end, dict.fromkeys(counts, 0)))
            earlier_ns, later_ns = self.span_ns or (first_ns, last_ns)
            self.span_ns = min(first_ns, earlier_ns), max(last_ns, later_ns)
            self.message_counts += counts

    def _read(self, start: int, end: int) -> list[Message]:
        """Read the messages of a part in the order of the file."""
        return self._known_messages(start, self._unpack(start, end))

    def _unpack(self, start: int, end: int) -> list[McapRecord]:
        """Read the records of a part, of chunks those that they hold; leave out a damaged chunk."""
        records: list[McapRecord] = []
        if start == end:
            return records
        try:
            with self.path.open("rb") as stream:
                stream.seek(start)
                for record in self._records(stream, skip_magic=True):
                    records += _unpacked(record)
                    if stream.tell() >= end:
                        break
        except _DAMAGE:
            self._damaged.add(start)
        return records

    def _records(self, stream: BinaryIO, skip_magic: bool = False) -> Iterator[McapRecord]:
        return StreamReader(stream, skip_magic, emit_chunks=True, record_size_limit=self._size).records

    def _known_messages(self, start: int, records: Sequence[McapRecord]) -> list[Message]:
        """Return the messages of known channels, and note how many have times that ROS cannot express."""
        found = [record for record in records if isinstance(record, Message) and record.channel_id in self.channels]
        kept = [message for message in found if max(message.log_time, message.publish_time) <= _LATEST_NS]
        self._untimely[start] = len(found) - len(kept)
        return kept


def _unpacked(record: McapRecord) -> Sequence[McapRecord]:
    """Return the records of a chunk, or the record itself; raises one of `_DAMAGE` if it is damaged."""
    if not isinstance(record, Chunk):
        return [record]
    # With `breakup_chunk` instead, a report takes twice as long.
    stream, size = get_chunk_data_stream(record, validate_crc=True)
    data, at = stream.read(size), 0
    records: list[McapRecord] = []
    while at < size:
        opcode, length = _RECORD_HEAD.unpack_from(data, at)
        start, at = at + _RECORD_HEAD.size, at + _RECORD_HEAD.size + length
        if at > size:
            raise ValueError(f"a record of a chunk ends {at - size} bytes beyond it")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(data, start)
            content = data[start + _MESSAGE_HEAD.size : at]
            records.append(Message(channel, log_time, content, publish_time, sequence))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            records.append(kind.read(ReadDataStream(BytesIO(data[start:at]))))
    return records


def _indexed_times(stream: BinaryIO, channel: int, position: int) -> NDArray[np.int64]:
    """Read the times of a message index; raises one of `_DAMAGE` if there is none."""
    # `MessageIndex.read` takes seconds for the three million messages of ten minutes.
    stream.seek(position)
    opcode, _, number, size = _INDEX_HEAD.unpack(stream.read(_INDEX_HEAD.size))
    if (opcode, number) != (Opcode.MESSAGE_INDEX, channel):
        raise ValueError(f"no message index of channel {channel} at byte {position}")
    return np.frombuffer(stream.read(size), _INDEX_ENTRY)["time"].astype(np.int64)


def _is_complete(summary: Summary) -> bool:
    """Return whether a summary has the types of all channels, and finds all messages, at possible times."""
    if summary.statistics is None or summary.statistics.message_end_time > _LATEST_NS:
        return False
    counts = summary.statistics.channel_message_counts
    channels = [summary.channels.get(number) for number in counts]
    indexed = sum(
        (chunk.message_index_length - _INDEX_HEAD.size * len(chunk.message_index_offsets)) // _INDEX_ENTRY.itemsize
        for chunk in summary.chunk_indexes
    )
    is_known = all(channel is not None and channel.schema_id in summary.schemas for channel in channels)
    return is_known and indexed == sum(counts.values())
