"""One mcap file: what it holds, and its messages by time, also when its end is missing.

The `mcap` package reads the records. The chunks are opened here, one by one: its `SeekingReader.iter_messages` gives up
the whole file for one damaged chunk, and needs an index, which a recording that was not closed lacks.
"""

from __future__ import annotations

import dataclasses
import os
from array import array
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, ChunkIndex, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from contact_reach_ros.bags.mcap_records import DAMAGE, LATEST_NS, messages_of, summary_is_sound, unpacked
from contact_reach_ros.errors import BagError

PROFILE = "ros2"
"""Profile of the mcap files that rosbag2 writes."""

_LOOSE_BYTES = 2**20
"""Messages outside of chunks are read in portions of this size."""
_CACHED_PARTS = 4
"""Parts kept for the next request, which often lies close by: the viewer reads topic by topic and moment by moment."""
_RECEPTION = attrgetter("log_time")

Times = NDArray[np.int64]


@dataclasses.dataclass
class McapContents:
    """What an mcap file holds.

    Attributes
    ----------
    profile :
        Convention that the file follows: "ros2" for a bag; None if the file is cut before that.
    schemas, channels :
        By their number in the file.
    message_counts :
        Messages by channel number.
    start_ns, end_ns :
        Time of reception of the first and the last message, ns since the epoch; 0 if there is none.
    metadata :
        Metadata records by name; the last one of a name counts.
    cut_at :
        Byte position up to which a damaged file could be read, None for a whole one.
    """

    profile: str | None = None
    schemas: dict[int, Schema] = dataclasses.field(default_factory=dict)
    channels: dict[int, Channel] = dataclasses.field(default_factory=dict)
    message_counts: dict[int, int] = dataclasses.field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    metadata: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    cut_at: int | None = None


class _Part(NamedTuple):
    """Bytes `start` to `end` of the file, read at once: a chunk, or messages outside of chunks.

    The messages were received from `first_ns` to `last_ns`, on `channels`; these are empty if unknown.
    """

    start: int
    end: int
    first_ns: int
    last_ns: int
    channels: frozenset[int]


class McapFile:
    """A recording in one mcap file; raises `BagError` if the file is missing, empty, or no mcap file.

    Attributes
    ----------
    path :
        The file.
    contents :
        What it holds.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as stream:
                start = stream.read(len(MCAP0_MAGIC))
                self._size = os.fstat(stream.fileno()).st_size
        except OSError as error:
            raise BagError(f"{path}: cannot be opened: {error.strerror}") from error
        if not start:
            raise BagError(f"{path}: is empty; the recording stopped before anything was written")
        if start != MCAP0_MAGIC:
            raise BagError(f"{path}: is no mcap file (its first bytes are {start.hex(' ')})")
        self._chunks: list[ChunkIndex] = []
        self._parts: list[_Part] = []
        self._damaged: set[int] = set()
        self._times: dict[int, array[int]] = {}
        self._read = lru_cache(_CACHED_PARTS)(self._read_part)
        self.contents = self._read_summary() or self._scan()
        self._parts.sort(key=lambda part: (part.first_ns, part.start))

    @property
    def damaged_chunks(self) -> int:
        """Number of chunks found damaged so far; their messages are lost."""
        return len(self._damaged)

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[tuple[str, Message]]:
        """Yield topic and message by time of reception, from a time in ns since the epoch on.

        Messages are held back only as long as a later part may have older ones. Damaged chunks are left out.
        """
        names = {number: channel.topic for number, channel in self.contents.channels.items() if channel.topic in topics}
        waiting: list[Message] = []
        for part in self._parts:
            unwanted = part.channels and part.channels.isdisjoint(names)
            if unwanted or part.last_ns < start_ns:
                continue
            ready = bisect_left(waiting, part.first_ns, key=_RECEPTION)
            yield from ((names[message.channel_id], message) for message in waiting[:ready])
            found = [m for m in self._read(part) if m.channel_id in names and m.log_time >= start_ns]
            # Stable: messages of the same time stay in the order of the file.
            waiting = sorted(waiting[ready:] + found, key=_RECEPTION)
        yield from ((names[message.channel_id], message) for message in waiting)

    def reception_times(self) -> dict[int, Times]:
        """Return times of reception, (n,) in ns since the epoch, by channel number, in the order of the file."""
        if self._chunks:
            try:
                found = self._indexed_times()
            except DAMAGE:
                found = {}
            if all(len(found.get(channel, ())) == count for channel, count in self.contents.message_counts.items()):
                return found
        if not self._times:
            # The file has no message indexes, or damaged ones.
            for part in sorted(self._parts):
                self._keep_times(self._read_part(part))
        return {channel: np.array(times, np.int64) for channel, times in self._times.items()}

    def _read_part(self, part: _Part) -> list[Message]:
        """Read the messages of a part in the order of the file; none if it is damaged."""
        records: list[McapRecord] = []
        try:
            with self.path.open("rb") as stream:
                stream.seek(part.start)
                for record in self._records(stream, skip_magic=True):
                    records += unpacked(record)
                    if stream.tell() >= part.end:
                        break
        except DAMAGE:
            self._damaged.add(part.start)
            return []
        return messages_of(records, self.contents.channels)

    def _records(self, stream: BinaryIO, skip_magic: bool = False) -> Iterator[McapRecord]:
        reader = StreamReader(stream, skip_magic=skip_magic, emit_chunks=True, record_size_limit=self._size)
        return reader.records

    def _read_summary(self) -> McapContents | None:
        """Read the summary at the end of the file; None if it is missing, damaged, or lacks what reading needs."""
        with self.path.open("rb") as stream:
            reader = SeekingReader(stream)
            try:
                summary = reader.get_summary() if summary_is_sound(stream) else None
                if summary is None or summary.statistics is None or not self._is_complete(summary):
                    return None
                metadata = {record.name: record.metadata for record in reader.iter_metadata()}
                profile = reader.get_header().profile
            except (*DAMAGE, OSError):
                # OSError: a file that is shorter than a footer.
                return None
        self._chunks = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
        for chunk in self._chunks:
            start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
            channels = frozenset(chunk.message_index_offsets)
            self._parts.append(_Part(start, end, chunk.message_start_time, chunk.message_end_time, channels))
        counts, statistics = summary.statistics.channel_message_counts, summary.statistics
        start_ns, end_ns = statistics.message_start_time, statistics.message_end_time
        return McapContents(profile, summary.schemas, summary.channels, dict(counts), start_ns, end_ns, metadata)

    def _is_complete(self, summary: Summary) -> bool:
        """Return whether a summary has what reading by index needs: files of other writers may leave parts out."""
        counted = summary.statistics.channel_message_counts if summary.statistics else {}
        channels = [summary.channels.get(number) for number in counted]
        known = all(channel is not None and channel.schema_id in summary.schemas for channel in channels)
        inside = all(chunk.chunk_start_offset + chunk.chunk_length <= self._size for chunk in summary.chunk_indexes)
        return known and inside and bool(summary.chunk_indexes or not counted)

    def _scan(self) -> McapContents:
        """Read the file from its beginning to its end, or to where it is cut."""
        contents, position = McapContents(), 0
        with self.path.open("rb") as stream:
            try:
                for record in self._records(stream):
                    start, end = position, stream.tell()
                    try:
                        records = unpacked(record)
                    except DAMAGE:
                        if end >= self._size:
                            # Nothing follows: this is where the file is cut.
                            raise
                        self._damaged.add(start)
                        records = []
                    for found in records:
                        if isinstance(found, Header):
                            contents.profile = found.profile
                        elif isinstance(found, Metadata):
                            contents.metadata[found.name] = found.metadata
                        elif isinstance(found, Schema):
                            contents.schemas[found.id] = found
                        elif isinstance(found, Channel):
                            contents.channels[found.id] = found
                    if messages := messages_of(records, contents.channels):
                        self._add_part(start, end, messages, is_loose=isinstance(record, Message))
                    position = end
            except DAMAGE:
                contents.cut_at = position
        contents.message_counts = {channel: len(times) for channel, times in self._times.items()}
        contents.start_ns = min((part.first_ns for part in self._parts), default=0)
        contents.end_ns = max((part.last_ns for part in self._parts), default=0)
        return contents

    def _add_part(self, start: int, end: int, messages: Sequence[Message], is_loose: bool) -> None:
        self._keep_times(messages)
        times = [message.log_time for message in messages]
        part = _Part(start, end, min(times), max(times), frozenset(message.channel_id for message in messages))
        if is_loose and self._parts and self._parts[-1].end == start and end - self._parts[-1].start <= _LOOSE_BYTES:
            last = self._parts.pop()
            first_ns, last_ns = min(last.first_ns, part.first_ns), max(last.last_ns, part.last_ns)
            part = _Part(last.start, end, first_ns, last_ns, last.channels | part.channels)
        self._parts.append(part)

    def _keep_times(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self._times.setdefault(message.channel_id, array("q")).append(message.log_time)

    def _indexed_times(self) -> dict[int, Times]:
        """Read times of reception by channel from the message indexes; raises one of `DAMAGE` if one is damaged."""
        # Not by `MessageIndex.read`, which takes seconds for the three million messages of ten minutes.
        found: dict[int, list[Times]] = {}
        with self.path.open("rb") as stream:
            data = ReadDataStream(stream)
            for chunk in self._chunks:
                for number, position in chunk.message_index_offsets.items():
                    if position >= self._size:
                        raise ValueError(f"message index at byte {position}, beyond the end of the file")
                    stream.seek(position)
                    opcode, _, channel, size = data.read1(), data.read8(), data.read2(), data.read4()
                    if (opcode, channel) != (Opcode.MESSAGE_INDEX, number):
                        raise ValueError(f"no message index at byte {position}")
                    # Pairs of time and position.
                    entries = np.frombuffer(data.read(size), "<u8").reshape(-1, 2)
                    if entries.max(initial=0) > LATEST_NS:
                        raise ValueError(f"message index at byte {position} has times that ROS cannot express")
                    found.setdefault(channel, []).append(entries[:, 0].astype(np.int64))
        return {channel: np.concatenate(parts) for channel, parts in found.items()}
