"""What the chunks of an mcap file hold, and their index: by slices of bytes, since a bag has millions of messages."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from operator import itemgetter
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.stream_reader import get_chunk_data_stream

DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError)
"""What the libraries raise where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text, or a
length that nothing can have."""

_RECORD = struct.Struct("<BQ")
"""Opcode and length."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, sequence, times of reception and of sending."""
_INDEX = struct.Struct("<BQHI")
"""Opcode, length, channel and number of bytes of the entries."""
_INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


class StoredMessage(NamedTuple):
    """A message of an mcap file, times in ns since the epoch."""

    log_time_ns: int
    publish_time_ns: int
    channel_id: int
    sequence: int
    data: bytes


_TIME = itemgetter(0)


def chunk_content(chunk: Chunk) -> bytes:
    """The records of a chunk, unpacked and checked; one of `DAMAGE` is raised where they are not what was written."""
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(length)


def chunk_messages(content: bytes) -> list[StoredMessage]:
    """The messages of a chunk in the order of the file."""
    return [
        StoredMessage(received, sent, channel, sequence, content[at + _MESSAGE.size : end])
        for opcode, at, end in _records(content)
        if opcode == Opcode.MESSAGE
        for channel, sequence, received, sent in (_MESSAGE.unpack_from(content, at),)
    ]


def chunk_definitions(content: bytes) -> Iterator[Schema | Channel]:
    """The schemas and channels that a chunk introduces."""
    for opcode, at, end in _records(content):
        if opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(content[at:end])))
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(content[at:end])))


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record."""
    at = 0
    while at < len(content):
        opcode, length = _RECORD.unpack_from(content, at)
        at += _RECORD.size
        end = at + length
        if end > len(content):
            raise ValueError(f"a record of {length} bytes ends behind its chunk")
        yield opcode, at, end
        at = end


def read_chunk(stream: BinaryIO, index: ChunkIndex) -> bytes:
    """The content of the chunk that an index points to; one of `DAMAGE` is raised where there is none."""
    stream.seek(index.chunk_start_offset + _RECORD.size)
    return chunk_content(Chunk.read(ReadDataStream(stream)))


class OrderedChunks:
    """The messages of an indexed file by time of reception; chunks that are damaged are left out.

    Chunks are unpacked one by one, and their messages are held back only as long as a later chunk may have older ones.

    Attributes
    ----------
    damaged :
        Positions in the file of the chunks that were left out.
    """

    def __init__(self, indexes: list[ChunkIndex]) -> None:
        self._indexes = sorted(indexes, key=lambda index: (index.message_start_time, index.chunk_start_offset))
        self.damaged: set[int] = set()

    def messages(self, stream: BinaryIO, channels: set[int], start_ns: int = 0) -> Iterator[StoredMessage]:
        """Messages of some channels, from a time of reception on."""
        waiting: list[StoredMessage] = []
        for index in self._indexes:
            unwanted = index.message_index_offsets and channels.isdisjoint(index.message_index_offsets)
            if unwanted or index.message_end_time < start_ns:
                continue
            if waiting and waiting[-1].log_time_ns < index.message_start_time:
                yield from waiting
                waiting = []
            elif waiting:
                ready = [message for message in waiting if message.log_time_ns < index.message_start_time]
                yield from ready
                waiting = waiting[len(ready) :]
            try:
                found = chunk_messages(read_chunk(stream, index))
            except DAMAGE:
                self.damaged.add(index.chunk_start_offset)
                continue
            waiting += [message for message in found if message[2] in channels and message[0] >= start_ns]
            # Stable: messages of the same time stay in the order of the file.
            waiting.sort(key=_TIME)
        yield from waiting


def reception_times(stream: BinaryIO, indexes: list[ChunkIndex]) -> dict[int, np.ndarray]:
    """Times of reception, (n,) in ns since the epoch, of each channel in the order of the file, from the index alone.

    One of `DAMAGE` is raised where the index is not what was written.
    """
    found: dict[int, list[np.ndarray]] = {}
    for index in sorted(indexes, key=lambda index: index.chunk_start_offset):
        stream.seek(index.chunk_start_offset + index.chunk_length)
        content = stream.read(index.message_index_length)
        at = 0
        while at < len(content):
            opcode, length, channel, size = _INDEX.unpack_from(content, at)
            at += _RECORD.size
            start = at + _INDEX.size - _RECORD.size
            if opcode != Opcode.MESSAGE_INDEX or start + size > len(content):
                raise ValueError(f"no message index at byte {index.chunk_start_offset + index.chunk_length}")
            entries = np.frombuffer(content, _INDEX_ENTRY, size // _INDEX_ENTRY.itemsize, start)
            found.setdefault(channel, []).append(entries["time"].astype(np.int64))
            at += length
    return {channel: np.concatenate(parts) for channel, parts in found.items()}
