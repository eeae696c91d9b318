"""The messages of one mcap file, as this and other writers store them."""

from pathlib import Path
from typing import Any

import pytest
from mcap.records import Message
from mcap.writer import CompressionType, IndexType, Writer

from contact_reach_ros.bags.mcap_file import McapFile
from contact_reach_ros.errors import BagError

COUNT = 50


def write(path: Path, **options: Any) -> list[tuple[str, Message]]:
    """A file of several chunks with two channels that take turns; its messages in the order of the file."""
    written: list[tuple[str, Message]] = []
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, **options)
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


def check(path: Path, written: list[tuple[str, Message]]) -> McapFile:
    file = McapFile(path)
    # Stable: what was received at the same time stays in the order of the file.
    assert list(file.messages(["/a", "/b"])) == sorted(written, key=lambda entry: entry[1].log_time)
    assert list(file.messages(["/b"], 997)) == [
        entry for entry in file.messages(["/a", "/b"]) if entry[0] == "/b" and entry[1].log_time >= 997
    ]
    for number, channel in file.channels.items():
        assert file.message_counts[number] == sum(name == channel.topic for name, _ in written)
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


def test_messages_outside_of_chunks_are_refused_with_a_remedy(tmp_path):
    write(tmp_path / "a.mcap", use_chunking=False)
    with pytest.raises(BagError, match="outside of chunks; `ros2 bag convert`"):
        McapFile(tmp_path / "a.mcap")
