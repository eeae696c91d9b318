"""Columns of messages that differ in layout, are cut, or are none."""

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.bags.columns import Arrays, JointStates
from contact_reach_ros.bags.reader import RawMessage

NAMES = ("a", "b", "c")


def raw(number: int, data: bytes) -> RawMessage:
    return RawMessage("/topic", 1000 + number, 500 + number, data, number)


def state(number: int) -> JointState:
    """In turns with other orders of the joints, fewer of them, and other times."""
    names = [NAMES, NAMES[::-1], NAMES[:1], (*NAMES, "gripper")][number // 10 % 4]
    message = JointState(name=names, effort=[number + NAMES.index(n) if n in NAMES else -1.0 for n in names])
    message.header.stamp.sec, message.header.stamp.nanosec = number - 20, number
    return message


def test_messages_of_several_layouts_come_in_their_order() -> None:
    collector = JointStates(("effort",), NAMES)
    for number in range(200):
        collector.add(raw(number, serialize_message(state(number))))
    column = collector.column()
    assert column.refused == 0
    assert column.log_ns.tolist() == list(range(1000, 1200))
    assert column.sequence.tolist() == list(range(200))
    np.testing.assert_array_equal(column.stamp_ns, [(n - 20) * 1_000_000_000 + n for n in range(200)])
    expected = np.arange(200.0)[:, None] + np.arange(3.0)
    expected[np.arange(200) // 10 % 4 == 2, 1:] = np.nan
    np.testing.assert_array_equal(column.values, expected)


def test_what_is_no_message_is_counted_and_left_out() -> None:
    collector = JointStates(("effort",), NAMES)
    bad = {
        0: b"",
        17: b"\0\1\0\0",
        50: serialize_message(state(50))[:-9],
        99: b"\0\0" + serialize_message(state(99))[2:],
    }
    for number in range(100):
        collector.add(raw(number, bad.get(number, serialize_message(state(number)))))
    column = collector.column()
    assert column.refused == len(bad)
    assert column.sequence.tolist() == [number for number in range(100) if number not in bad]


def test_arrays_of_another_size_become_nan() -> None:
    collector = Arrays(2)
    for number, size in enumerate((2, 3, 2, 0, 2)):
        collector.add(raw(number, serialize_message(Float64MultiArray(data=[float(number)] * size))))
    column = collector.column()
    assert column.refused == 0
    np.testing.assert_array_equal(column.values[:, 0], [0.0, np.nan, 2.0, np.nan, 4.0])
