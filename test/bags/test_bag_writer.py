import os
import resource
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import START_NS, STEP_NS, TYPES, SampleBag
from mcap.reader import make_reader
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError

TEXT = RecordedTopic("/text", "std_msgs/msg/String")


def text(content: str = "hello") -> bytes:
    return serialize_message(String(data=content))


def test_mcap_library_reads_what_was_written(shared_sample: SampleBag) -> None:
    sample = shared_sample
    with sample.file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == len(sample.written)
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
        read = [
            (channel.topic, message.log_time, message.publish_time, message.sequence, message.data)
            for _, channel, message in reader.iter_messages()
        ]
    assert read == [
        (topic, received, sent, number, data) for number, (topic, received, sent, _, data) in enumerate(sample.written)
    ]


def test_channels_and_schemas_are_those_of_rosbag2(shared_sample: SampleBag) -> None:
    with shared_sample.file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == set(shared_sample.topics)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert schema.name == shared_sample.topics[channel.topic]
        assert schema.encoding == "ros2msg"
        assert channel.message_encoding == "cdr"
        assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]["durability"] == "transient_local"


def test_rosbags_and_the_middleware_read_what_was_written(shared_sample: SampleBag) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(shared_sample.directory) as reader:
        assert {topic: about.msgtype for topic, about in reader.topics.items()} == shared_sample.topics
        assert reader.message_count == len(shared_sample.written)
        assert reader.start_time == START_NS
        for connection in reader.connections:
            assert connection.digest == store.hash_rihs01(connection.msgtype)
        for (topic, received, _, message, _), (connection, time, data) in zip(
            shared_sample.written, reader.messages(), strict=True
        ):
            assert (connection.topic, time) == (topic, received)
            assert deserialize_message(bytes(data), TYPES[topic]) == message
            assert store.deserialize_cdr(data, connection.msgtype) is not None


def test_metadata(shared_sample: SampleBag) -> None:
    content = yaml.safe_load((shared_sample.directory / "metadata.yaml").read_text())
    assert list(content) == ["rosbag2_bagfile_information"]
    information = content["rosbag2_bagfile_information"]
    topics = information.pop("topics_with_message_count")
    count = len(shared_sample.written)
    span = {
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "duration": {"nanoseconds": (count - 1) * STEP_NS},
        "message_count": count,
    }
    assert information == {
        "version": 9,
        "storage_identifier": "mcap",
        **span,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["sample_0.mcap"],
        "files": [{"path": "sample_0.mcap", **span}],
        "custom_data": {"scene": "ball", "seed": "7"},
        "ros_distro": "jazzy",
    }
    assert {entry["topic_metadata"]["name"]: entry["message_count"] for entry in topics} == dict.fromkeys(
        TYPES, count // 5
    )
    unlimited = {"sec": 9223372036, "nsec": 854775807}
    for entry in topics:
        metadata = entry["topic_metadata"]
        assert metadata["type"] == shared_sample.topics[metadata["name"]]
        assert metadata["serialization_format"] == "cdr"
        assert metadata["type_description_hash"].startswith("RIHS01_")
        assert metadata["offered_qos_profiles"] == [
            {
                "history": "keep_last",
                "depth": 1,
                "reliability": "reliable",
                "durability": "transient_local",
                "deadline": unlimited,
                "lifespan": unlimited,
                "liveliness": "automatic",
                "liveliness_lease_duration": unlimited,
                "avoid_ros_namespace_conventions": False,
            }
        ]


def test_topics_can_be_added_late(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", [TEXT]) as writer:
        writer.write("/text", text(), 1)
        writer.flush()
        writer.add_topic(RecordedTopic("/more", "std_msgs/msg/String"))
        writer.add_topic(RecordedTopic("/state", "sensor_msgs/msg/JointState"))
        writer.write("/more", text(), 2)
        writer.write("/state", serialize_message(JointState()), 3)
    with Reader(tmp_path / "bag") as reader:
        assert [connection.topic for connection, _, _ in reader.messages()] == ["/text", "/more", "/state"]


def test_closed_when_the_block_is_left_by_an_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), BagWriter(tmp_path / "bag", [TEXT]) as writer:
        writer.write("/text", text(), 1)
        raise ZeroDivisionError
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 1


def test_misuse_is_named(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "bag", [TEXT])
    with pytest.raises(BagError, match="'/other': add the topic first"):
        writer.write("/other", text(), 1)
    with pytest.raises(BagError, match="'/text' is added twice"):
        writer.add_topic(TEXT)
    writer.close()
    with pytest.raises(BagError, match="closed"):
        writer.write("/text", text(), 1)
    with pytest.raises(BagError, match="closed"):
        writer.add_topic(RecordedTopic("/late", "std_msgs/msg/String"))


def test_what_is_to_survive_a_power_cut_is_handed_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr("os.fdatasync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    with BagWriter(tmp_path / "bag", [TEXT]) as writer:
        writer.write("/text", text("x" * 1000), 1)
        writer.flush(durable=True)
        size = (writer.directory / "bag_0.mcap").stat().st_size
        assert size > 100
    assert synced == [size, (tmp_path / "bag" / "bag_0.mcap").stat().st_size]


def test_disk_that_fails_later_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("os.fdatasync", fail)
    writer = BagWriter(tmp_path / "bag", [TEXT])
    writer.flush(durable=True)
    with pytest.raises(BagError, match="Input/output error"):
        writer.close()


def test_custom_data_of_an_unfinished_bag_is_the_newest(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "bag", [TEXT], custom_data={"seed": "3"})
    writer.set_custom_data("parameters", "planner: {}")
    writer.flush()
    assert BagReader(tmp_path / "bag").custom_data == {"seed": "3", "parameters": "planner: {}"}
    writer.close()


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
