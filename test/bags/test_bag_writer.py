import os
import resource
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import START_NS, STEP_NS, TYPES, SampleBag
from mcap.reader import make_reader
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import String

from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError

UNLIMITED = QosTime(9223372036, 854775807)
TEXT = RecordedTopic("/text", "std_msgs/msg/String")


def text(content: str = "hello") -> bytes:
    return serialize_message(String(data=content))


def test_the_file_is_as_rosbag2_writes_it(shared_sample: SampleBag) -> None:
    with shared_sample.file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        sequences = [message.sequence for _, _, message in reader.iter_messages()]
    assert sequences == list(range(len(shared_sample.written)))
    assert summary is not None and summary.statistics is not None
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
    assert {channel.topic for channel in summary.channels.values()} == set(shared_sample.topics)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (schema.name, schema.encoding) == (shared_sample.topics[channel.topic], "ros2msg")
        assert channel.message_encoding == "cdr"
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["durability"] == "transient_local"


def test_rosbags_and_the_middleware_read_what_was_written(shared_sample: SampleBag) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(shared_sample.directory) as reader:
        assert {topic: about.msgtype for topic, about in reader.topics.items()} == shared_sample.topics
        assert reader.message_count == len(shared_sample.written)
        assert (reader.start_time, reader.duration) == (START_NS, (reader.message_count - 1) * STEP_NS + 1)
        for connection in reader.connections:
            assert connection.digest == store.hash_rihs01(connection.msgtype)
            assert connection.msgcount == reader.message_count // 5
            (qos,) = connection.ext.offered_qos_profiles
            assert qos == Qos(
                *(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL),
                *(UNLIMITED, UNLIMITED, QosLiveliness.AUTOMATIC, UNLIMITED, False),
            )
        for (topic, received, _, message, _), (connection, time, data) in zip(
            shared_sample.written, reader.messages(), strict=True
        ):
            assert (connection.topic, time) == (topic, received)
            assert deserialize_message(bytes(data), TYPES[topic]) == message
            assert store.deserialize_cdr(data, connection.msgtype) is not None


def test_what_is_to_survive_a_power_cut_is_handed_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr("os.fdatasync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    with BagWriter(tmp_path / "bag", [TEXT]) as writer:
        writer.write("/text", text("x" * 1000), 1)
        writer.flush()
        size = (writer.directory / "bag_0.mcap").stat().st_size
        assert size > 100
    assert synced == [size, (tmp_path / "bag" / "bag_0.mcap").stat().st_size]


def test_full_disk_is_reported(tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk."""
    writer = BagWriter(tmp_path / "bag", [TEXT])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = np.random.default_rng(0).bytes(100_000).hex()
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        with pytest.raises(BagError, match="cannot be written: File too large"):
            for time in range(100):
                writer.write("/text", text(noise), time)
        with pytest.raises(BagError, match="cannot be written"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    writer.close()
