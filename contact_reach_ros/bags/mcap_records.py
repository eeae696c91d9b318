"""Records of mcap files, checked: those of a chunk, and the summary."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Collection, Sequence
from io import BytesIO
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

DAMAGE = (McapError, struct.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError, OverflowError)
"""What the libraries raise where a file is cut or damaged: in a record, a number, a chunk (zstd, lz4), a text, or a
length that nothing can have."""
LATEST_NS = 2**63 - 1
"""Last time that ROS can express; a message with a later one is damaged."""
_CHECKSUM_BYTES = 4
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Beginnings of a record, opcode and length, and of a message: channel, sequence, times of reception and sending."""


def unpacked(record: McapRecord) -> list[McapRecord]:
    """Return the records of a chunk, checked, or the record itself.

    Not by `breakup_chunk`: its seven reads for each message made the report on ten minutes take three times as long.
    """
    if not isinstance(record, Chunk):
        return [record]
    stream, size = get_chunk_data_stream(record, validate_crc=True)
    data = stream.read(size)
    records: list[McapRecord] = []
    at = 0
    while at < size:
        opcode, length = _RECORD.unpack_from(data, at)
        start, at = at + _RECORD.size, at + _RECORD.size + length
        if at > size:
            raise ValueError(f"a record of a chunk ends {at - size} bytes beyond it")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            content = data[start + _MESSAGE.size : at]
            records.append(Message(channel, log_time, content, publish_time, sequence))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            records.append(kind.read(ReadDataStream(BytesIO(data[start:at]))))
    return records


def messages_of(records: Sequence[McapRecord], channels: Collection[int]) -> list[Message]:
    """The messages of known channels whose times ROS can express."""
    messages = (record for record in records if isinstance(record, Message) and record.channel_id in channels)
    return [message for message in messages if max(message.log_time, message.publish_time) <= LATEST_NS]


def summary_is_sound(stream: BinaryIO) -> bool:
    """Return whether the summary matches the checksum in the footer; `SeekingReader` does not look."""
    stream.seek(-FOOTER_SIZE - len(MCAP0_MAGIC), os.SEEK_END)
    data = ReadDataStream(stream)
    _opcode, _length, footer = data.read1(), data.read8(), Footer.read(data)
    if not footer.summary_crc or not footer.summary_start:
        return True
    stream.seek(footer.summary_start)
    content = stream.read()[: -len(MCAP0_MAGIC) - _CHECKSUM_BYTES]
    return zlib.crc32(content) == footer.summary_crc
