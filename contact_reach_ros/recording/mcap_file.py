"""One mcap file: what it holds, and its messages, also when its end is missing."""

from __future__ import annotations

import dataclasses
import os
import struct
import zlib
from array import array
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording.mcap_chunks import (
    DAMAGE,
    Block,
    OrderedChunks,
    StoredMessage,
    chunk_content,
    chunk_definitions,
    chunk_messages,
    read_blocks,
    reception_times,
)

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "ros2"
"""Of the mcap files that rosbag2 writes."""

# Opcode, length, positions of summary and summary offsets, checksum.
_FOOTER = struct.Struct("<BQQQI")
_CHECKSUM_BYTES = 4


@dataclasses.dataclass(frozen=True)
class McapContents:
    """What an mcap file holds.

    Attributes
    ----------
    profile :
        What its writer says it follows: "ros2" for a bag; None if the file is cut before that.
    schemas, channels :
        By their number in the file.
    message_counts :
        Messages by channel number.
    start_ns, end_ns :
        Time of reception of the first and the last message, ns since the epoch; 0 if there is none.
    metadata :
        Metadata records by name; the last one of a name counts.
    indexed :
        True if the file is complete and has an index, so that it need not be read from front to end.
    cut_at :
        Byte position up to which a damaged file could be read, None for a whole one.
    """

    profile: str | None
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    message_counts: dict[int, int]
    start_ns: int
    end_ns: int
    metadata: dict[str, dict[str, str]]
    indexed: bool
    cut_at: int | None


class McapFile:
    """A recording in one mcap file, opened anew for every pass over it.

    Attributes
    ----------
    path :
        The file.
    contents :
        What it holds.

    Raises
    ------
    BagError
        If the file is missing, empty, or no mcap file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as stream:
                start = stream.read(len(MAGIC))
        except OSError as error:
            raise BagError(f"{path}: cannot be opened: {error.strerror}") from error
        if not start:
            raise BagError(f"{path}: is empty; the recording stopped before anything was written")
        if start != MAGIC:
            raise BagError(f"{path}: is no mcap file (its first bytes are {start.hex(' ')})")
        self._chunks: list[ChunkIndex] = []
        self._times: dict[int, array[int]] = {}
        self._damaged: set[int] = set()
        self.contents = self._read_summary() or self._scan()

    @property
    def damaged_chunks(self) -> int:
        """Chunks that were found to be damaged so far; their messages are lost."""
        return len(self._damaged)

    def messages(self, topics: Collection[str], start_ns: int = 0) -> Iterator[tuple[Channel, StoredMessage]]:
        """Messages of the topics from a time of reception on: by that time, or as in the file where it has no index."""
        channels = {number: channel for number, channel in self.contents.channels.items() if channel.topic in topics}
        with self.path.open("rb") as stream:
            if self.contents.indexed:
                ordered = OrderedChunks(self._chunks)
                ordered.damaged = self._damaged
                found = ordered.messages(stream, set(channels), start_ns)
            else:
                found = (message for message in _Records(stream).messages() if message.log_time_ns >= start_ns)
            for message in found:
                channel = channels.get(message.channel_id)
                if channel is not None:
                    yield channel, message

    def blocks(self, channels: set[int]) -> Iterator[dict[int, Block]]:
        """The messages of some channels of an indexed file, chunk by chunk in the order of the file."""
        with self.path.open("rb") as stream:
            for index in sorted(self._chunks, key=lambda index: index.chunk_start_offset):
                if index.message_index_offsets and channels.isdisjoint(index.message_index_offsets):
                    continue
                try:
                    found = read_blocks(stream, index, channels)
                except DAMAGE:
                    self._damaged.add(index.chunk_start_offset)
                    continue
                yield found

    def reception_times(self) -> dict[int, np.ndarray]:
        """Times of reception, (n,) in ns since the epoch, by channel number and in the order of the file."""
        if not self.contents.indexed:
            return {channel: np.array(times, dtype=np.int64) for channel, times in self._times.items()}
        with self.path.open("rb") as stream:
            try:
                found = reception_times(stream, self._chunks)
            except DAMAGE:
                found = {}
        if all(len(found.get(channel, ())) == count for channel, count in self.contents.message_counts.items()):
            return found
        # A file without message indexes, or with damaged ones.
        times: dict[int, array[int]] = {}
        for channel, message in self.messages({channel.topic for channel in self.contents.channels.values()}):
            times.setdefault(channel.id, array("q")).append(message.log_time_ns)
        return {channel: np.array(received, dtype=np.int64) for channel, received in times.items()}

    def _read_summary(self) -> McapContents | None:
        """What the summary at the end says, None if it is missing or says too little."""
        with self.path.open("rb") as stream:
            reader = SeekingReader(stream)
            try:
                summary = reader.get_summary() if _summary_is_sound(stream) else None
                if summary is None or not _complete(summary) or summary.statistics is None:
                    return None
                metadata = {record.name: record.metadata for record in reader.iter_metadata()}
                profile = reader.get_header().profile
            except (*DAMAGE, OSError):
                # OSError: a file that is shorter than a footer.
                return None
        self._chunks = summary.chunk_indexes
        statistics = summary.statistics
        return McapContents(
            profile,
            summary.schemas,
            summary.channels,
            dict(statistics.channel_message_counts),
            statistics.message_start_time,
            statistics.message_end_time,
            metadata,
            indexed=True,
            cut_at=None,
        )

    def _scan(self) -> McapContents:
        with self.path.open("rb") as stream:
            records = _Records(stream)
            for message in records.messages():
                self._times.setdefault(message.channel_id, array("q")).append(message.log_time_ns)
        self._damaged = records.damaged
        filled = self._times.values()
        return McapContents(
            records.profile,
            records.schemas,
            records.channels,
            {channel: len(times) for channel, times in self._times.items()},
            min((min(times) for times in filled), default=0),
            max((max(times) for times in filled), default=0),
            records.metadata,
            indexed=False,
            cut_at=records.cut_at,
        )


class _Records:
    """The records of a stream, those inside chunks included, up to its end or to where it is cut.

    A chunk that is whole but not what was written is left out.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._size = os.fstat(stream.fileno()).st_size
        self.profile: str | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.damaged: set[int] = set()
        self.cut_at: int | None = None

    def messages(self) -> Iterator[StoredMessage]:
        """The messages in the order of the file; the rest is kept in the attributes."""
        position = 0
        try:
            for record in StreamReader(self._stream, emit_chunks=True, record_size_limit=self._size).records:
                if isinstance(record, Chunk):
                    yield from self._unpack(record, position)
                elif isinstance(record, Message):
                    if record.channel_id in self.channels:
                        yield StoredMessage(
                            record.log_time, record.publish_time, record.channel_id, record.sequence, record.data
                        )
                elif isinstance(record, Header):
                    self.profile = record.profile
                elif isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                elif isinstance(record, Schema | Channel):
                    self._define(record)
                position = self._stream.tell()
        except DAMAGE:
            self.cut_at = position

    def _unpack(self, chunk: Chunk, position: int) -> list[StoredMessage]:
        try:
            content = chunk_content(chunk)
            for definition in chunk_definitions(content):
                self._define(definition)
            return [message for message in chunk_messages(content) if message.channel_id in self.channels]
        except DAMAGE:
            if self._stream.tell() >= self._size:
                # Nothing follows: this is where the file is cut.
                raise
            self.damaged.add(position)
            return []

    def _define(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        else:
            self.channels[record.id] = record


def _summary_is_sound(stream: BinaryIO) -> bool:
    """Whether the summary has the checksum that the footer gives; one that has none is believed."""
    stream.seek(-_FOOTER.size - len(MAGIC), os.SEEK_END)
    footer = stream.read(_FOOTER.size)
    _, _, summary_start, _, checksum = _FOOTER.unpack(footer)
    if not checksum or not summary_start:
        return True
    stream.seek(summary_start)
    content = stream.read()[: -len(MAGIC) - _CHECKSUM_BYTES]
    return zlib.crc32(content) == checksum


def _complete(summary: Summary) -> bool:
    """Whether a summary has what reading by index needs: files of other writers may leave parts out."""
    counted = summary.statistics.channel_message_counts if summary.statistics else {}
    repeated = all(
        number in summary.channels and summary.channels[number].schema_id in summary.schemas for number in counted
    )
    return summary.statistics is not None and repeated and bool(summary.chunk_indexes or not counted)
