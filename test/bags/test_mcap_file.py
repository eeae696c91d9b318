"""The messages of a file with several chunks, with none, and with message indexes that are missing or damaged."""

import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.writer import IndexType, Writer

from contact_reach_ros.bags import mcap_file
from contact_reach_ros.bags.mcap_file import McapFile

COUNT = 50


def write(path: Path, index_types: IndexType = IndexType.ALL, **options: bool) -> list[tuple[str, Message]]:
    """A file of several chunks with two channels that take turns; what was written, in its order."""
    written: list[tuple[str, Message]] = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, index_types=index_types, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channels = {name: writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")}
        for number in range(COUNT):
            # Not in the order of time.
            name = ("/a", "/b")[number % 3 % 2]
            message = Message(channels[name], 1000 - number % 7, b"m" * (number + 1), 500 + number, number)
            writer.add_message(message.channel_id, message.log_time, message.data, message.publish_time, number)
            written.append((name, message))
        writer.finish()
    return written


def check(path: Path, written: list[tuple[str, Message]]) -> None:
    file = McapFile(path)
    # Stable: what was received at the same time stays in the order of the file.
    assert list(file.messages(["/a", "/b"])) == sorted(written, key=lambda entry: entry[1].log_time)
    assert list(file.messages(["/b"], 997)) == [
        entry for entry in file.messages(["/a", "/b"]) if entry[0] == "/b" and entry[1].log_time >= 997
    ]
    times = file.reception_times()
    assert set(times) == set(file.contents.channels)
    for number, channel in file.contents.channels.items():
        expected = [message.log_time for name, message in written if name == channel.topic]
        assert times[number].tolist() == expected
        assert file.contents.message_counts[number] == len(expected)
    assert (file.contents.start_ns, file.contents.end_ns) == (994, 1000)
    assert file.damaged_chunks == 0


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE])
def test_messages_are_as_written(tmp_path, index_types):
    written = write(tmp_path / "a.mcap", index_types)
    check(tmp_path / "a.mcap", written)


@pytest.mark.parametrize("portion", [500, 2**20])
def test_messages_outside_of_chunks_are_as_written(tmp_path, monkeypatch, portion):
    monkeypatch.setattr(mcap_file, "_LOOSE_BYTES", portion)
    written = write(tmp_path / "a.mcap", use_chunking=False)
    check(tmp_path / "a.mcap", written)


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
    check(path, written)
