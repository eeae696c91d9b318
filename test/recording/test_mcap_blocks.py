"""The messages of a chunk, by its message indexes or, where they are missing or damaged, without."""

import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import IndexType, Writer

from contact_reach_ros.recording.mcap_file import McapFile

COUNT = 50


def write(path: Path, index_types: IndexType = IndexType.ALL) -> dict[int, list[tuple[int, int, int, bytes]]]:
    """A file of several chunks with two channels that take turns; what was written, by channel."""
    written: dict[int, list[tuple[int, int, int, bytes]]] = {}
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, index_types=index_types)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channels = [writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")]
        for number in range(COUNT):
            # Not in the order of time.
            message = 1000 - number % 7, 500 + number, number, b"m" * (number + 1)
            channel = channels[number % 3 % 2]
            writer.add_message(channel, message[0], message[3], message[1], message[2])
            written.setdefault(channel, []).append(message)
        writer.finish()
    return written


def read(path: Path) -> dict[int, list[tuple[int, int, int, bytes]]]:
    file = McapFile(path)
    found: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for blocks in file.blocks(set(file.contents.channels)):
        for number, block in blocks.items():
            for row in range(len(block.starts)):
                entry = int(block.log_ns[row]), int(block.publish_ns[row]), int(block.sequence[row]), block.data(row)
                found.setdefault(number, []).append(entry)
    assert file.damaged_chunks == 0
    return found


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE])
def test_messages_are_as_written_in_the_order_of_the_file(tmp_path, index_types):
    written = write(tmp_path / "a.mcap", index_types)
    assert read(tmp_path / "a.mcap") == written


def test_a_damaged_message_index_loses_no_message(tmp_path):
    path = tmp_path / "a.mcap"
    written = write(path)
    content = bytearray(path.read_bytes())
    at, damaged = 8, 0
    while content[at] != Opcode.DATA_END:
        opcode, length = struct.unpack_from("<BQ", content, at)
        if opcode == Opcode.MESSAGE_INDEX:
            # The first offset: now behind the chunk.
            struct.pack_into("<Q", content, at + 9 + 2 + 4 + 8, 2**40 + damaged)
            damaged += 1
        at += 9 + length
    assert damaged > 2
    path.write_bytes(content)
    assert read(path) == written
