"""Serialised messages are read and written as rclpy would do it."""

import numpy as np
import pytest
from arm_simulation import ARM
from geometry_msgs.msg import WrenchStamped
from hostile import garbage
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import serialized
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.serialized import (
    JointStateReader,
    command_writer,
    joint_state_writer,
    read_command,
    wrench_writer,
)
from contact_reach_ros.messages.values import nanoseconds

NAMES = list(ARM.joint_names)
STAMP_NS = 1_700_000_000_123_456_789


def joint_state(names, random, effort=True, frame_id="lbr_link_0", stamp_ns=STAMP_NS):
    message = JointState(name=list(names))
    message.header.frame_id, message.header.stamp = frame_id, to_time(stamp_ns)
    message.position = random.standard_normal(len(names)).tolist()
    message.velocity = random.standard_normal(len(names)).tolist()
    message.effort = random.standard_normal(len(names)).tolist() if effort else []
    return message


def values_by_name(message, field):
    return [getattr(message, field)[message.name.index(name)] for name in NAMES]


def test_joint_states_of_any_layout_are_read_like_decoded_ones():
    random = np.random.default_rng(0)
    reader = JointStateReader(NAMES, "joint_states")
    layouts = [
        {"names": NAMES, "effort": False},
        {"names": NAMES[::-1], "frame_id": ""},
        {"names": ["gripper", *NAMES[2:], *NAMES[:2]], "frame_id": "some other frame"},
    ]
    for layout in layouts:
        # From the second one on the numbers are taken from where they stood in the first.
        for stamp_ns in (STAMP_NS, STAMP_NS + 1, 5):
            message = joint_state(random=random, stamp_ns=stamp_ns, **layout)
            state = reader.read(serialize_message(message))
            assert state.stamp_ns == stamp_ns
            assert state.q.tolist() == values_by_name(message, "position")
            assert state.v.tolist() == values_by_name(message, "velocity")
            if message.effort:
                assert state.torque.tolist() == values_by_name(message, "effort")
            else:
                assert state.torque is None


def test_other_names_or_counts_are_noticed_though_the_size_is_the_same():
    random = np.random.default_rng(0)
    reader = JointStateReader(NAMES, "joint_states")
    message = joint_state(NAMES, random)
    state = reader.read(serialize_message(message))
    for names in ([*NAMES[:6], "lbr_A8"], NAMES[:6], []):
        with pytest.raises(InputError, match=r"name lacks .*lbr_A7: it has .*; expected all"):
            reader.read(serialize_message(joint_state(names, random)))
    # Which of the two values is right nobody knows.
    with pytest.raises(InputError, match="name has lbr_A1 more than once"):
        reader.read(serialize_message(joint_state(["lbr_A1", *NAMES], random)))
    reader.read(serialize_message(joint_state([*NAMES, "finger", "finger"], random)))
    first = message.position.tolist()
    message.velocity, message.effort = [0.0] * 6, [0.0] * 8
    with pytest.raises(InputError, match="velocity has 6 values"):
        reader.read(serialize_message(message))
    assert reader.read(serialize_message(joint_state(NAMES, random))).q.shape == (7,)
    assert state.q.tolist() == first, "a state is overwritten by later messages"
    message.velocity = [0.0] * 7
    with pytest.raises(InputError, match="effort has 8 values"):
        reader.read(serialize_message(message))


@pytest.mark.parametrize("fields", [("position", "velocity", "effort"), ("position", "effort")])
@pytest.mark.parametrize("names", [NAMES, ["a", "bcdef", ""]])
def test_written_joint_states_are_decoded_by_rclpy(fields, names):
    writer = joint_state_writer(names, "lbr_link_0", fields)
    for stamp_ns in (STAMP_NS, 1):
        values = dict(zip(fields, np.random.default_rng(0).standard_normal((len(fields), len(names))), strict=True))
        message = deserialize_message(writer.write(*values.values(), stamp_ns=stamp_ns), JointState)
        assert nanoseconds(message.header.stamp) == stamp_ns
        assert (message.header.frame_id, message.name) == ("lbr_link_0", names)
        for field in ("position", "velocity", "effort"):
            assert getattr(message, field).tolist() == list(values.get(field, []))


def test_what_is_behind_a_message_does_not_matter(monkeypatch):
    """The middleware leaves what the memory held before, such as the end of another message."""
    encode = serialized.encode
    left = np.full(1, serialized.SLOT).tobytes()
    monkeypatch.setattr(serialized, "encode", lambda message: encode(message)[:-8] + left)
    names = ["wx200/shoulder_link", "wx200/upper_arm_link", "max"]
    plain = encode(JointState(name=names, effort=[serialized.SLOT] * 3))
    assert serialized.encode(JointState(name=names, effort=[serialized.SLOT] * 3)) != plain
    written = joint_state_writer(names, "", ["effort"]).write([1.0, 2.0, 3.0], stamp_ns=0)
    assert deserialize_message(written, JointState).effort.tolist() == [1.0, 2.0, 3.0]


def test_written_wrenches_are_decoded_by_rclpy():
    values = np.random.default_rng(0).standard_normal(6)
    message = deserialize_message(wrench_writer("lbr_link_0").write(values, stamp_ns=STAMP_NS), WrenchStamped)
    force, torque = message.wrench.force, message.wrench.torque
    assert nanoseconds(message.header.stamp) == STAMP_NS and message.header.frame_id == "lbr_link_0"
    assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == values.tolist()


def test_commands_of_any_layout_are_read():
    for count, label in ((0, ""), (7, ""), (7, "joints"), (8, "arm")):
        message = Float64MultiArray(data=np.arange(count, dtype=float).tolist())
        if label:
            message.layout.dim = [MultiArrayDimension(label=label, size=count, stride=count)]
            message.layout.data_offset = 1
        assert read_command(serialize_message(message)).tolist() == message.data.tolist()
    written = deserialize_message(command_writer(7).write(np.arange(7.0)), Float64MultiArray)
    assert written == Float64MultiArray(data=np.arange(7.0).tolist())


def test_bytes_that_are_no_message_are_refused():
    reader = JointStateReader(NAMES, "joint_states")
    message = serialize_message(joint_state(NAMES, np.random.default_rng(0)))
    for data in garbage(message):
        with pytest.raises(InputError, match=f"^joint_states: {len(data)} bytes that are no JointState; expected"):
            reader.read(data)
        assert reader.read(message).q.shape == (7,)
    for data in garbage(command_writer(7).write(np.ones(7))):
        with pytest.raises(InputError, match=f"commands: {len(data)} bytes that are no Float64MultiArray; expected"):
            read_command(data)
