from pathlib import Path

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.experiments.repeat import repeat_bag

MS = 1_000_000
START_S = 1_700_000_000


def test_repeated_bag_goes_on_with_the_same_messages(tmp_path: Path) -> None:
    known = [
        RecordedTopic("/joint_states", "sensor_msgs/msg/JointState"),
        RecordedTopic("/effort_controller/commands", "std_msgs/msg/Float64MultiArray"),
    ]
    with BagWriter(tmp_path / "short", known, custom_data={"scene": "ball"}) as writer:
        for tick in range(100):
            state = JointState(name=["a"], position=[float(tick)])
            state.header.stamp.sec, state.header.stamp.nanosec = 5, tick * MS
            received = START_S * 10**9 + 2 * tick * MS
            writer.write("/joint_states", serialize_message(state), received, received - 10)
            command = serialize_message(Float64MultiArray(data=[float(tick)]))
            writer.write("/effort_controller/commands", command, received + 1)
    assert repeat_bag(tmp_path / "short", tmp_path / "long", 0.95) == 10
    long = BagReader(tmp_path / "long")
    assert long.summary.custom_data == {"scene": "ball"}
    states = [deserialize_message(raw.data, JointState) for raw in long.raw_messages(["/joint_states"])]
    assert [state.position[0] for state in states] == [float(tick) for tick in range(100)] * 10
    stamps = [state.header.stamp.sec * 10**9 + state.header.stamp.nanosec for state in states]
    assert np.diff(stamps).tolist() == [MS] * 999
    assert (np.diff(long.reception_times("/joint_states")) > 0).all()
    short = [raw.data for raw in BagReader(tmp_path / "short").raw_messages(["/effort_controller/commands"])]
    assert [raw.data for raw in long.raw_messages(["/effort_controller/commands"])] == short * 10
