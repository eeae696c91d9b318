"""The recording that comes with the package is whole, small, and as its README describes it."""

import numpy as np
import pytest

from contact_reach_ros.bags.command import read_info
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.messages import topics
from contact_reach_ros.resources import share_directory
from contact_reach_ros.timing import NANOSECONDS

SAMPLE = share_directory() / "bags" / "sample"


@pytest.fixture(scope="module")
def reader() -> BagReader:
    return BagReader(SAMPLE)


def test_it_is_whole_and_small(reader: BagReader) -> None:
    assert sum(path.stat().st_size for path in SAMPLE.iterdir()) <= 2_000_000
    info = read_info(SAMPLE)
    assert info["notes"] == ()
    assert {topic["lost"] for topic in info["topics"]} == {0}
    assert {"scene", "seed", "parameter_file", "scene_file", "contact_budget", "versions"} <= set(info["custom_data"])


def test_it_has_every_tick_of_every_topic_of_a_lockstep_run(reader: BagReader) -> None:
    for topic in ("/joint_states", "/external_torque"):
        stamps = [message.header.stamp for message in reader.messages(topic)]
        found = [stamp.sec * NANOSECONDS + stamp.nanosec for stamp in stamps]
        assert len(found) > 1000
        # Equal ones come before the lockstep begins, when the driver publishes where the arm is until somebody listens.
        assert set(np.diff(found)) <= {0, 1_000_000}
        assert np.count_nonzero(np.diff(found)) > 1000
    # There was no adapter, and no controller ran in the shadow.
    absent = {topics.SHADOW_COMMANDS, topics.ADAPTER_COMMANDS}
    assert {name.lstrip("/") for name in reader.topics} >= {topic.name for topic in topics.ALL if topic not in absent}
