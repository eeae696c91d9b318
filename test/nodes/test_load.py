"""The load of `contact-reach bench bags`, and whether its losses are found."""

from pathlib import Path

import numpy as np

from contact_reach_ros.experiments.bench_bags import LOADED
from contact_reach_ros.nodes.graph_checks import type_name
from contact_reach_ros.nodes.load import streams
from contact_reach_ros.nodes.serialized import decode
from contact_reach_ros.recording.bag_writer import BagWriter
from contact_reach_ros.recording.load import NAMESPACE, Arrived, count_arrived
from contact_reach_ros.recording.topics import Topic

VALUES = np.random.default_rng(0).standard_normal(21)


def test_load_is_made_of_real_messages_of_all_topics():
    assert {stream.topic.name for stream in streams()} == set(LOADED)
    for stream in streams():
        message = decode(stream.write(7, VALUES), stream.topic.type, stream.topic.name)
        number = message.header.stamp.nanosec if hasattr(message, "header") else message.data[0]
        assert number == 7


def test_lost_messages_are_found_by_number_and_by_sequence(tmp_path: Path):
    load = [(stream, f"{NAMESPACE}/{stream.topic.name}") for stream in streams()]
    with BagWriter(tmp_path / "bag", [Topic(name, type_name(stream.topic)) for stream, name in load]) as writer:
        for number in range(2_000):
            for stream, name in load:
                if not (number in (3, 4, 1_500) and name.endswith("commands")):
                    writer.write(name, stream.write(number, VALUES), number, number, number + 10)
        # One that came twice makes up for none.
        stream, name = load[0]
        writer.write(name, stream.write(1_999, VALUES), 2_000, 2_000, 2_010)
    assert count_arrived(tmp_path / "bag", 2_000) == Arrived(topics=5, messages=9_997, missing=3, gaps=3)
