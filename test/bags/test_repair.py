import pytest
from conftest import SampleBag
from rosbags.rosbag2 import Reader

from contact_reach_ros.bags.command import repair_bag
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError


def killed(sample: SampleBag, lost_bytes: int) -> None:
    """As a recorder leaves the bag that is killed: without metadata, and without the end of the file."""
    (sample.directory / "metadata.yaml").unlink()
    sample.file.write_bytes(sample.file.read_bytes()[:-lost_bytes])


def test_repaired_bag_has_all_that_was_written_and_is_complete(sample: SampleBag, capsys) -> None:
    killed(sample, 50)
    before = sample.file.read_bytes()
    repair_bag(sample.directory)
    said = capsys.readouterr().out
    with pytest.raises(BagError, match="exists and is not overwritten"):
        repair_bag(sample.directory)
    repaired = sample.directory.with_name("sample_repaired")
    assert f"{len(sample.written)} messages of 5 topics are in {repaired}" in said
    assert "is cut or damaged" in said
    assert sample.file.read_bytes() == before
    whole = BagReader(repaired)
    assert whole.notes == ()
    assert whole.custom_data == {"scene": "ball", "seed": "7", "repaired_from": "sample"}
    read = [(raw.topic, raw.log_time_ns, raw.publish_time_ns, raw.data, raw.sequence) for raw in whole.raw_messages()]
    assert read == [(topic, log, sent, data, n) for n, (topic, log, sent, _, data) in enumerate(sample.written)]
    assert whole.topics["/goal_pose"].offered_qos[0].durability == "transient_local"
    with Reader(repaired) as reader:
        assert {topic: about.msgtype for topic, about in reader.topics.items()} == sample.topics
        assert len(list(reader.messages())) == len(sample.written)


def test_types_are_taken_from_the_bag(sample: SampleBag, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """They need not be installed where a bag is repaired."""
    monkeypatch.setattr("contact_reach_ros.bags.message_types.MessageTypes.definition", None)
    repair_bag(sample.directory)
    assert "of 5 topics" in capsys.readouterr().out
