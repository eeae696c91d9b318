"""The load of `contact-reach bench bags`, and whether its losses are found."""

from pathlib import Path

import numpy as np

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.experiments.bench_bags import LOADED, NAMESPACE, count_lost
from contact_reach_ros.experiments.load_publisher import streams
from contact_reach_ros.messages.cdr import decode

VALUES = np.random.default_rng(0).standard_normal(21)


def test_load_is_made_of_real_messages_of_all_topics():
    assert {stream.topic.name for stream in streams(load_arm("iiwa14"))} == set(LOADED)
    for stream in streams(load_arm("iiwa14")):
        message = decode(stream.write(7, VALUES), stream.topic.type, stream.topic.name)
        number = message.header.stamp.nanosec if hasattr(message, "header") else message.data[0]
        assert number == 7


def test_lost_messages_are_counted(tmp_path: Path):
    load = [(stream, f"{NAMESPACE}/{stream.topic.name}") for stream in streams(load_arm("iiwa14"))]
    with BagWriter(tmp_path / "bag", [RecordedTopic(name, stream.topic.type_name) for stream, name in load]) as writer:
        for number in range(2_000):
            for stream, name in load:
                if not (number in (3, 4, 1_500) and name.endswith("commands")):
                    writer.write(name, stream.write(number, VALUES), number, number, number + 10)
        # One that came twice makes up for none.
        stream, name = load[0]
        writer.write(name, stream.write(1_999, VALUES), 2_000, 2_000, 2_009)
    assert count_lost(tmp_path / "bag", 2_000) == 3
