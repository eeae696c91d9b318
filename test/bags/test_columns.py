"""Columns of messages that differ in layout, are cut, or are none."""

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.bags.columns import Arrays, JointStates
from contact_reach_ros.bags.mcap_file import MESSAGES, Messages

NAMES = ("a", "b", "c")


def raw(number: int, data: bytes) -> Messages:
    return np.array([(0, 1000 + number, 500 + number, data, number)], MESSAGES)


def state(number: int) -> JointState:
    """In turns with other orders of the joints, fewer of them, and other times."""
    names = [NAMES, NAMES[::-1], NAMES[:1], (*NAMES, "gripper")][number // 10 % 4]
    message = JointState(name=names, effort=[number + NAMES.index(n) if n in NAMES else -1.0 for n in names])
    message.header.stamp.sec, message.header.stamp.nanosec = number - 20, number
    return message


def test_messages_of_several_layouts_come_in_their_order_without_those_that_are_none() -> None:
    bad = {
        0: b"",
        17: b"\0\1\0\0",
        50: serialize_message(state(50))[:-9],
        99: b"\0\0" + serialize_message(state(99))[2:],
    }
    collector = JointStates(("effort",), NAMES)
    for number in range(200):
        collector(raw(number, bad.get(number, serialize_message(state(number)))))
    column = collector.column()
    assert column.refused == len(bad)
    good = np.array([number for number in range(200) if number not in bad])
    np.testing.assert_array_equal(column.log_ns, 1000 + good)
    np.testing.assert_array_equal(column.sequence, good)
    np.testing.assert_array_equal(column.stamp_ns, (good - 20) * 1_000_000_000 + good)
    expected = good[:, None] + np.arange(3.0)
    expected[good // 10 % 4 == 2, 1:] = np.nan
    np.testing.assert_array_equal(column.values, expected)


def test_arrays_of_another_size_become_nan() -> None:
    collector = Arrays(2)
    for number, size in enumerate((2, 3, 2, 0, 2)):
        collector(raw(number, serialize_message(Float64MultiArray(data=[float(number)] * size))))
    column = collector.column()
    assert column.refused == 0
    np.testing.assert_array_equal(column.values[:, 0], [0.0, np.nan, 2.0, np.nan, 4.0])
