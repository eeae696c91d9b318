"""What the chunks of an mcap file hold, and their index: by slices of bytes, since a bag has millions of messages."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Sequence
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
from numpy.typing import NDArray

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
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("received", "<u8"),
        ("sent", "<u8"),
    ]
)
"""What stands before the data of a message."""

Numbers = NDArray[np.int64]


class StoredMessage(NamedTuple):
    """A message of an mcap file, times in ns since the epoch."""

    log_time_ns: int
    publish_time_ns: int
    channel_id: int
    sequence: int
    data: bytes


class Block(NamedTuple):
    """Messages of one channel in one chunk, in the order of the file.

    Attributes
    ----------
    content
        The bytes that they are in.
    log_ns, publish_ns
        (n,) reception and sending, ns since the epoch.
    sequence
        (n,) numbers that the publisher gave.
    starts, sizes
        (n,) where the data of each is in the content.
    """

    content: bytes
    log_ns: Numbers
    publish_ns: Numbers
    sequence: Numbers
    starts: Numbers
    sizes: Numbers

    def data(self, row: int) -> bytes:
        """The data of one message."""
        start = int(self.starts[row])
        return self.content[start : start + int(self.sizes[row])]

    @classmethod
    def of(cls, messages: Sequence[tuple[int, int, int, bytes]]) -> Block:
        """A block of times of reception and of sending, numbers and data."""
        received, sent, numbers, data = zip(*messages, strict=True)
        sizes = np.array([len(content) for content in data], np.int64)
        log_ns, publish_ns, sequence = (np.array(column, np.int64) for column in (received, sent, numbers))
        return cls(b"".join(data), log_ns, publish_ns, sequence, np.cumsum(sizes) - sizes, sizes)


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


def read_blocks(stream: BinaryIO, index: ChunkIndex, channels: Collection[int]) -> dict[int, Block]:
    """The messages of some channels in the chunk that an index points to, by its message indexes if they are sound.

    One of `DAMAGE` is raised where the chunk is not what was written.
    """
    content = read_chunk(stream, index)
    if not index.message_index_offsets:
        return _walked_blocks(content, channels)
    try:
        entries = _message_indexes(stream, index)
        return {
            number: _block(content, number, np.sort(entries[number]["offset"]).astype(np.int64))
            for number in channels
            if number in index.message_index_offsets and len(entries[number])
        }
    except (ValueError, KeyError, struct.error):
        # The messages are there all the same, if their index is not.
        return _walked_blocks(content, channels)


def _walked_blocks(content: bytes, channels: Collection[int]) -> dict[int, Block]:
    """The same without an index, record by record."""
    starts = [at - _RECORD.size for opcode, at, _ in _records(content) if opcode == Opcode.MESSAGE]
    found = np.array(starts, np.int64)
    owners = _heads(content, found)["channel"]
    offsets = {number: found[owners == number] for number in channels}
    return {number: _block(content, number, at) for number, at in offsets.items() if len(at)}


def _block(content: bytes, channel: int, offsets: Numbers) -> Block:
    heads = _heads(content, offsets)
    starts, sizes = offsets + _HEAD.itemsize, heads["length"].astype(np.int64) - _MESSAGE.size
    whole = sizes.min() >= 0 and (starts + sizes).max() <= len(content)
    if not (whole and (heads["opcode"] == Opcode.MESSAGE).all() and (heads["channel"] == channel).all()):
        raise ValueError(f"the index of channel {channel} does not point to its messages")
    log_ns, publish_ns, sequence = (heads[name].astype(np.int64) for name in ("received", "sent", "sequence"))
    return Block(content, log_ns, publish_ns, sequence, starts, sizes)


def _heads(content: bytes, offsets: Numbers) -> NDArray[np.void]:
    """What stands before the data of the messages at some places, (n,)."""
    if len(offsets) and not 0 <= offsets.min() <= offsets.max() <= len(content) - _HEAD.itemsize:
        raise ValueError("a message index points behind its chunk")
    rows = np.frombuffer(content, np.uint8)[offsets[:, None] + np.arange(_HEAD.itemsize)]
    return rows.view(_HEAD)[:, 0]


def _message_indexes(stream: BinaryIO, index: ChunkIndex) -> dict[int, NDArray[np.void]]:
    """Times and offsets of the messages of each channel in a chunk, (n,)."""
    behind = index.chunk_start_offset + index.chunk_length
    stream.seek(behind)
    content = stream.read(index.message_index_length)
    found = {}
    at = 0
    while at < len(content):
        opcode, length, channel, size = _INDEX.unpack_from(content, at)
        start = at + _INDEX.size
        if opcode != Opcode.MESSAGE_INDEX or start + size > len(content):
            raise ValueError(f"no message index at byte {behind}")
        found[channel] = np.frombuffer(content, _INDEX_ENTRY, size // _INDEX_ENTRY.itemsize, start)
        at += _RECORD.size + length
    return found


def reception_times(stream: BinaryIO, indexes: list[ChunkIndex]) -> dict[int, Numbers]:
    """Times of reception, (n,) in ns since the epoch, of each channel in the order of the file, from the index alone.

    One of `DAMAGE` is raised where the index is not what was written.
    """
    found: dict[int, list[Numbers]] = {}
    for index in sorted(indexes, key=lambda index: index.chunk_start_offset):
        for channel, entries in _message_indexes(stream, index).items():
            found.setdefault(channel, []).append(entries["time"].astype(np.int64))
    return {channel: np.concatenate(parts) for channel, parts in found.items()}
