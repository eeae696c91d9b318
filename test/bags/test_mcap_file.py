"""The messages of one mcap file, as this and other writers store them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mcap.writer
import pytest
import zstandard
from mcap.records import Message
from mcap.writer import CompressionType, IndexType, Writer

from contact_reach_ros.bags.mcap_file import McapFile, in_order

COUNT = 50


def write(
    path: Path, loose_from: int = COUNT, began_ns: int = 0, astray: Mapping[int, int] | None = None, **options: Any
) -> list[tuple[str, Message]]:
    """A file of several chunks with two channels that take turns; its messages in the order of the file.

    Those from a number on are outside of chunks, and `astray` ones were received at another time.
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
            received_ns = (astray or {}).get(number, began_ns + 1000 - number % 7)
            message = Message(channels[name], received_ns, b"m" * (number + 1), 500 + number, number)
            if number == loose_from:
                writer._Writer__finalize_chunk()
                writer._Writer__chunk_builder = None
            writer.add_message(message.channel_id, message.log_time, message.data, message.publish_time, number)
            written.append((name, message))
        writer.finish()
    return written


def read(file: McapFile, topics: Sequence[str], start_ns: int = 0) -> list[tuple[Any, ...]]:
    """Topic, times of reception and of sending, data and sequence of each message."""
    found = [row for batch in in_order([file], topics, start_ns) for row in batch.tolist()]
    return [(topics[number], *row) for number, *row in found]


def rows(written: list[tuple[str, Message]]) -> list[tuple[Any, ...]]:
    """The written messages as `read` has them."""
    ordered = sorted(written, key=lambda entry: entry[1].log_time)
    return [(name, m.log_time, m.publish_time, m.data, m.sequence) for name, m in ordered]


def check(path: Path, written: list[tuple[str, Message]]) -> McapFile:
    file = McapFile(path)
    # Stable: what was received at the same time stays in the order of the file.
    assert read(file, ["/a", "/b"]) == rows(written)
    assert read(file, ["/b"], 997) == [row for row in rows(written) if row[0] == "/b" and row[1] >= 997]
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
        {"use_chunking": False},
        {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
    ],
)
def test_messages_are_as_written(tmp_path, options):
    """Other writers may leave out parts of index and summary."""
    written = write(tmp_path / "a.mcap", **options)
    assert list(check(tmp_path / "a.mcap", written).notes()) == []


def test_compressed_chunks_need_not_tell_their_size(tmp_path, monkeypatch):
    def compress(data):
        stream = zstandard.ZstdCompressor(write_content_size=False).compressobj()
        return stream.compress(data) + stream.flush()

    monkeypatch.setattr(mcap.writer.zstandard, "compress", compress)
    written = write(tmp_path / "a.mcap", compression=CompressionType.ZSTD)
    assert list(check(tmp_path / "a.mcap", written).notes()) == []


def test_messages_after_the_chunks_are_read_and_counted(tmp_path):
    written = write(tmp_path / "a.mcap", loose_from=COUNT // 2)
    assert list(check(tmp_path / "a.mcap", written).notes()) == []


@pytest.mark.parametrize("index_types", [IndexType.ALL, IndexType.ALL & ~IndexType.MESSAGE, IndexType.NONE])
def test_messages_that_were_all_received_at_0_are_read(tmp_path, index_types):
    """As a simulation before its clock has begun, or a converter, writes them."""
    written = write(tmp_path / "a.mcap", astray=dict.fromkeys(range(COUNT), 0), index_types=index_types)
    file = McapFile(tmp_path / "a.mcap")
    assert read(file, ["/a", "/b"]) == rows(written) and file.span_ns == (0, 0)


@pytest.mark.parametrize("time", [0, (1 << 64) - 5])
def test_a_message_of_an_impossible_time_is_left_out_with_a_note(tmp_path, time):
    year_ns = 366 * 24 * 3600 * 10**9
    written = write(tmp_path / "a.mcap", began_ns=40 * year_ns, astray={7: time})
    file = McapFile(tmp_path / "a.mcap")
    kept = [entry for entry in written if entry[1].sequence != 7]
    assert read(file, ["/a", "/b"]) == rows(kept)
    assert file.span_ns == (40 * year_ns + 994, 40 * year_ns + 1000)
    assert list(file.notes()) == [
        "a.mcap: 1 messages are left out, received more than a year before or after the others"
    ]
