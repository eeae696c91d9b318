"""The messages of a file with chunks, without, with both, and with message indexes that are missing or damaged."""

import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import DataEnd, Footer, Message
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer

from contact_reach_ros.bags import mcap_file
from contact_reach_ros.bags.mcap_file import McapFile

COUNT = 50


def write(path: Path, times: dict[int, int] | None = None, **options: Any) -> list[tuple[str, Message]]:
    """A file of several chunks with two channels that take turns; what was written, in its order.

    `times` are times of reception by number of the message, in place of the usual ones.
    """
    written: list[tuple[str, Message]] = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channels = {name: writer.register_channel(name, "cdr", schema) for name in ("/a", "/b")}
        for number in range(COUNT):
            # Not in the order of time.
            name = ("/a", "/b")[number % 3 % 2]
            time = (times or {}).get(number, 1000 - number % 7)
            message = Message(channels[name], time, b"m" * (number + 1), 500 + number, number)
            writer.add_message(message.channel_id, message.log_time, message.data, message.publish_time, number)
            written.append((name, message))
        writer.finish()
    return written


def check(path: Path, written: list[tuple[str, Message]]) -> McapFile:
    file = McapFile(path)
    # Stable: what was received at the same time stays in the order of the file.
    assert list(file.messages(["/a", "/b"])) == sorted(written, key=lambda entry: entry[1].log_time)
    assert list(file.messages(["/b"], 997)) == [
        entry for entry in file.messages(["/a", "/b"]) if entry[0] == "/b" and entry[1].log_time >= 997
    ]
    times = file.reception_times()
    assert set(times) == set(file.channels)
    for number, channel in file.channels.items():
        expected = [message.log_time for name, message in written if name == channel.topic]
        assert times[number].tolist() == expected
        assert file.message_counts[number] == len(expected)
    assert file.span_ns == (994, 1000)
    return file


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
)
def test_messages_are_as_written(tmp_path, options):
    """Other writers may leave out parts of index and summary."""
    written = write(tmp_path / "a.mcap", **options)
    assert list(check(tmp_path / "a.mcap", written).notes()) == []


@pytest.mark.parametrize("portion", [500, 2**20])
def test_messages_outside_of_chunks_are_as_written(tmp_path, monkeypatch, portion):
    monkeypatch.setattr(mcap_file, "_PART_BYTES", portion)
    written = write(tmp_path / "a.mcap", use_chunking=False)
    assert list(check(tmp_path / "a.mcap", written).notes()) == []


def test_messages_behind_the_chunks_are_as_written(tmp_path):
    """The statistics count them, but the index finds only those in chunks."""
    path = tmp_path / "a.mcap"
    written = write(path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    behind = [message for _, message in written[:5]]
    rest = RecordBuilder()
    for message in behind:
        message.write(rest)
        summary.statistics.channel_message_counts[message.channel_id] += 1
    summary.statistics.message_count += len(behind)
    DataEnd(0).write(rest)
    end = max(
        index.chunk_start_offset + index.chunk_length + index.message_index_length for index in summary.chunk_indexes
    )
    start = end + rest.count
    for record in (*summary.schemas.values(), *summary.channels.values(), summary.statistics, *summary.chunk_indexes):
        record.write(rest)
    Footer(start, 0, 0).write(rest)
    path.write_bytes(path.read_bytes()[:end] + rest.end() + MCAP0_MAGIC)
    assert list(check(path, [*written, *written[:5]]).notes()) == []


def test_messages_at_impossible_times_are_left_out_and_reported(tmp_path):
    written = write(tmp_path / "a.mcap", times={20: 2**64 - 5})
    file = check(tmp_path / "a.mcap", [entry for number, entry in enumerate(written) if number != 20])
    (note,) = file.notes()
    assert "1 messages with a time after the year 2262 are left out" in note


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
