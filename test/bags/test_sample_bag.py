"""The recording that comes with the package is whole, small, and what its README says."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader

from contact_reach_ros.bags.info import read_info
from contact_reach_ros.bags.playback import Playback, read_ahead
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.recorded_qos import publisher_qos
from contact_reach_ros.nodes.replay import choose_topics
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.plans import RecordedPlans
from contact_reach_ros.resources import share_directory
from contact_reach_ros.units import NANOSECONDS

SAMPLE = share_directory() / "bags" / "sample"


@pytest.fixture(scope="module")
def reader() -> BagReader:
    return BagReader(SAMPLE)


def test_it_is_whole_and_small(reader: BagReader) -> None:
    assert sum(path.stat().st_size for path in SAMPLE.iterdir()) <= 2_000_000
    info = read_info(SAMPLE)
    assert info.notes == ()
    assert {topic.lost for topic in info.topics} == {0}
    assert {topic.out_of_order for topic in info.topics} == {0}
    assert {"scene", "seed", "parameter_file", "scene_file", "contact_budget", "versions"} <= set(info.custom_data)


def test_it_has_every_tick_of_every_topic_of_a_lockstep_run(reader: BagReader) -> None:
    stamps = {"/joint_states": [], "/external_torque": []}
    for item in reader.messages(stamps):
        stamp = item.message.header.stamp
        stamps[item.topic].append(stamp.sec * NANOSECONDS + stamp.nanosec)
    for found in stamps.values():
        assert len(found) > 1000
        # Equal ones come before the lockstep begins, when the driver says where the arm is until somebody listens.
        assert set(np.diff(found)) <= {0, 1_000_000}
        assert np.count_nonzero(np.diff(found)) > 1000
    # Nobody made things go wrong, no controller ran in the shadow, and there was no adapter.
    # The sample is of an earlier version, without goal/state.
    absent = {topics.SIM_FAULTS, topics.SHADOW_COMMANDS, topics.ADAPTER_COMMANDS, topics.GOAL_STATE}
    assert {name.lstrip("/") for name in reader.topics()} >= {topic.name for topic in topics.ALL if topic not in absent}


def test_its_plans_can_be_made_again(reader: BagReader) -> None:
    """Today's planner takes what the bag has; that it comes to the same is tested with a bag of the same machine."""
    plans = RecordedPlans(RecordedInputs(reader))
    assert 40 in plans.statistics


def test_other_libraries_read_it(reader: BagReader) -> None:
    counts = {name: topic.message_count for name, topic in reader.topics().items()}
    with Reader(SAMPLE) as other:
        assert {name: topic.msgcount for name, topic in other.topics.items()} == counts
    (file,) = SAMPLE.glob("*.mcap")
    with file.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/goal_pose"])
        (goal,) = [item[3] for item in decoded]
    assert goal.pose.position.x == pytest.approx(0.51)


def test_it_can_be_replayed(reader: BagReader) -> None:
    """All of it but the way through the middleware, which test_replay.py goes."""
    chosen = choose_topics(reader, None, everything=True)
    assert set(chosen) == set(reader.topics())
    for topic in reader.topics().values():
        assert publisher_qos(topic.name, topic.offered_qos).depth >= 1
    published: list[str] = []
    start_ns = reader.summary.start_ns + int((reader.summary.duration - 5.0) * NANOSECONDS)
    messages = read_ahead(reader.raw_messages(list(chosen), start_ns))
    assert Playback(rate=100.0).run(messages, start_ns, lambda raw: published.append(raw.topic))
    assert len(published) == sum(1 for _ in reader.raw_messages(None, start_ns)) > 10
