"""One mcap file: what it holds, and its messages, also when its end is missing."""

from __future__ import annotations

import dataclasses
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

from contact_reach_ros.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

# Opcode, length, positions of summary and summary offsets, checksum.
_FOOTER = struct.Struct("<BQQQI")
_CHECKSUM_BYTES = 4

# What the libraries raise where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text,
# or a length that nothing can have.
_DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError)


@dataclasses.dataclass(frozen=True)
class McapContents:
    """What an mcap file holds.

    Attributes
    ----------
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
        self.contents = self._read_summary() or self._scan()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[Channel, Message]]:
        """Messages of the topics: by time of reception, or in the order of the file where it has no index.

        Raises
        ------
        BagError
            If an indexed file turns out to be damaged.
        """
        with self.path.open("rb") as stream:
            if not self.contents.indexed:
                yield from self._messages_until_cut(stream, topics)
                return
            try:
                for _, channel, message in SeekingReader(stream, validate_crcs=True).iter_messages(topics):
                    yield channel, message
            except _DAMAGE as error:
                raise BagError(f"{self.path}: is damaged: {error}") from error

    def _read_summary(self) -> McapContents | None:
        """What the summary at the end says, None if it is missing or says too little."""
        with self.path.open("rb") as stream:
            reader = SeekingReader(stream)
            try:
                summary = reader.get_summary() if _summary_is_sound(stream) else None
                if summary is None or not _complete(summary) or summary.statistics is None:
                    return None
                metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            except (*_DAMAGE, OSError):
                # OSError: a file that is shorter than a footer.
                return None
        statistics = summary.statistics
        return McapContents(
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
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        counts: Counter[int] = Counter()
        metadata: dict[str, dict[str, str]] = {}
        start_ns, end_ns = 0, 0
        with self.path.open("rb") as stream:
            records = _Records(stream)
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Metadata):
                    metadata[record.name] = record.metadata
                elif isinstance(record, Message):
                    start_ns = min(start_ns, record.log_time) if counts else record.log_time
                    end_ns = max(end_ns, record.log_time)
                    counts[record.channel_id] += 1
        return McapContents(
            schemas, channels, dict(counts), start_ns, end_ns, metadata, indexed=False, cut_at=records.cut_at
        )

    def _messages_until_cut(self, stream: BinaryIO, topics: Collection[str]) -> Iterator[tuple[Channel, Message]]:
        channels = self.contents.channels
        for record in _Records(stream):
            if isinstance(record, Message) and channels[record.channel_id].topic in topics:
                yield channels[record.channel_id], record


class _Records:
    """The records of a stream, those inside chunks included, up to its end or to where it is damaged."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.cut_at: int | None = None

    def __iter__(self) -> Iterator[McapRecord]:
        position = 0
        try:
            for record in StreamReader(self._stream, emit_chunks=True).records:
                # A chunk that is cut fails its checksum here, before any of its messages is passed on.
                yield from breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
                position = self._stream.tell()
        except _DAMAGE:
            self.cut_at = position


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
