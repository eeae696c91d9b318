"""One mcap file: its contents, and its messages by time of reception.

The `mcap` package reads the records. A file is opened by its index; one without a complete index, such as that of a
recorder that was killed or whose disk was full, is read up to its end, or to where it is cut. Chunks are read one by
one, since `SeekingReader.iter_messages` gives up the whole file for a damaged one.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator, Set
from functools import lru_cache
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

_DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError, OSError)
"""Errors of the libraries where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text, or an
impossible length."""
_HEAD_BYTES = 9
"""Bytes of opcode and length before the content of a record."""


_INDEX_BYTES, _ENTRY_BYTES = 15, 16
"""Bytes of a chunk's index of the messages of one channel, without its entries, and of an entry."""
_MOST_LOOSE = 10_000
"""Messages outside of chunks that are read at once."""
_ASTRAY_NS = 366 * 24 * 3600 * NANOSECONDS
"""Time from the middle message of a file from which on a message was not received when the file has it, ns."""


class _Chunk(NamedTuple):
    """Place in the file, reception of the first and last message, ns, and channels; these are empty if not known."""

    start: int
    first_ns: int
    last_ns: int
    channels: Set[int]
    loose: int = 0
    """Number of messages, if they are one after the other outside of chunks."""


class McapFile:
    """A recording in one mcap file.

    Raises `BagError` if the file is missing, empty, or no mcap file.

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
        self.metadata: dict[str, dict[str, str]] = {}
        self._chunks: list[_Chunk] = []
        self._cut_at: int | None = None
        self._damaged: set[int] = set()
        self._possible_ns = 0, 1 << 64
        """Times of reception outside of which messages are left out, ns."""
        self._astray = 0
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
        self._chunks.sort(key=attrgetter("first_ns", "start"))
        self.span_ns: tuple[int, int] | None = None
        if self._chunks:
            self.span_ns = self._chunks[0].first_ns, max(chunk.last_ns for chunk in self._chunks)
            if self.span_ns[1] - self.span_ns[0] > _ASTRAY_NS:
                self.span_ns = self._leave_out_astray()
        # The next request often lies close by: the viewer reads topic by topic and moment by moment.
        self._read_cached = lru_cache(4)(self._read)

    def notes(self) -> Iterator[str]:
        """Yield a sentence about each kind of defect found so far."""
        name = self.path.name
        if self._cut_at is not None:
            yield f"{name} is cut or damaged: readable up to byte {self._cut_at} of {self._size}"
        if self._damaged:
            yield f"{name}: {len(self._damaged)} chunks are damaged, their messages are left out"
        if self._astray:
            yield f"{name}: {self._astray} messages are left out, received more than a year before or after the others"

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[tuple[str, Message]]:
        """Yield topic and message by time of reception, from a time in ns since the epoch on.

        Messages are held back only as long as a later chunk may have older ones. Damaged chunks are left out.
        """
        names = {number: channel.topic for number, channel in self.channels.items() if channel.topic in topics}
        waiting: list[Message] = []
        start_ns, end_ns = max(start_ns, self._possible_ns[0]), self._possible_ns[1]
        for chunk in self._chunks:
            if chunk.last_ns < start_ns or (chunk.channels and names.keys().isdisjoint(chunk.channels)):
                continue
            ready = bisect_left(waiting, chunk.first_ns, key=attrgetter("log_time"))
            yield from ((names[message.channel_id], message) for message in waiting[:ready])
            read = self._read_cached(chunk.start, chunk.loose)
            found = [
                message for message in read if message.channel_id in names and start_ns <= message.log_time <= end_ns
            ]
            # Stable: messages of the same time stay in the order of the file.
            waiting = sorted(waiting[ready:] + found, key=attrgetter("log_time"))
        yield from ((names[message.channel_id], message) for message in waiting)

    def _open_by_index(self) -> bool:
        """Take contents and chunks from the summary; returns False if it is missing, damaged or incomplete."""
        try:
            with self.path.open("rb") as stream:
                reader = SeekingReader(stream, record_size_limit=self._size)
                summary = reader.get_summary()
                if summary is None or summary.statistics is None:
                    return False
                metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        except _DAMAGE:
            return False
        counts, chunks = summary.statistics.channel_message_counts, summary.chunk_indexes
        types = {channel.schema_id for channel in summary.channels.values()}
        complete = counts.keys() <= summary.channels.keys() and types <= summary.schemas.keys()
        indexed = sum(c.message_index_length - _INDEX_BYTES * len(c.message_index_offsets) for c in chunks)
        # Others are outside of chunks, or the writer made no index.
        complete = complete and (not indexed or indexed == _ENTRY_BYTES * summary.statistics.message_count)
        if not complete or len(chunks) != summary.statistics.chunk_count or not chunks:
            return False
        self.schemas, self.channels, self.metadata = summary.schemas, summary.channels, metadata
        self.message_counts.update(counts)
        self._chunks = [
            _Chunk(c.chunk_start_offset, c.message_start_time, c.message_end_time, c.message_index_offsets.keys())
            for c in chunks
            if c.message_index_offsets or c.message_end_time
        ]
        return True

    def _scan(self) -> None:
        """Go through the file to its end, or to where it is cut."""
        end = len(MCAP0_MAGIC)
        with self.path.open("rb") as stream:
            try:
                for record in StreamReader(stream, emit_chunks=True, record_size_limit=self._size).records:
                    start, end = end, stream.tell()
                    if isinstance(record, Message):
                        self.message_counts[record.channel_id] += 1
                        follows = bool(self._chunks) and 0 < self._chunks[-1].loose < _MOST_LOOSE
                        run = self._chunks.pop() if follows else _Chunk(start, record.log_time, 0, frozenset())
                        ends_ns = min(run.first_ns, record.log_time), max(run.last_ns, record.log_time)
                        self._chunks.append(_Chunk(run.start, *ends_ns, frozenset(), run.loose + 1))
                    elif isinstance(record, Metadata):
                        self.metadata[record.name] = record.metadata
                    elif isinstance(record, Chunk):
                        found = Counter(message.channel_id for message in self._break_up(record, start))
                        self.message_counts += found
                        if found:
                            span_ns = record.message_start_time, record.message_end_time
                            self._chunks.append(_Chunk(start, *span_ns, found.keys()))
                    else:
                        self._define(record)
            except _DAMAGE:
                self._cut_at = end

    def _read(self, start: int, loose: int) -> list[Message]:
        """Read the messages of the chunk at byte `start` in the order of the file, or so many loose ones from there.

        A damaged chunk has none.
        """
        try:
            with self.path.open("rb") as stream:
                if loose:
                    stream.seek(start)
                    records = StreamReader(stream, skip_magic=True, record_size_limit=self._size).records
                    return list(islice((each for each in records if isinstance(each, Message)), loose))
                stream.seek(start + _HEAD_BYTES)
                chunk = Chunk.read(ReadDataStream(stream))
        except _DAMAGE:
            self._damaged.add(start)
            return []
        return self._break_up(chunk, start)

    def _leave_out_astray(self) -> tuple[int, int]:
        """Leave out messages received long before or after the middle one; returns the span of the others, ns."""
        read = (self._read(chunk.start, chunk.loose) for chunk in self._chunks)
        received = sorted(message.log_time for messages in read for message in messages)
        middle = received[len(received) // 2] if received else 0
        self._possible_ns = middle - _ASTRAY_NS, middle + _ASTRAY_NS
        kept = [time for time in received if abs(time - middle) <= _ASTRAY_NS] or [middle]
        self._astray = len(received) - len(kept)
        return kept[0], kept[-1]

    def _break_up(self, chunk: Chunk, start: int) -> list[Message]:
        """Take the definitions in a chunk and return its messages in the order of the file; a damaged one has none."""
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except _DAMAGE:
            self._damaged.add(start)
            return []
        for record in records:
            self._define(record)
        return [record for record in records if isinstance(record, Message) and record.channel_id in self.channels]

    def _define(self, record: object) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
