"""A recorder that comes late or stands still, as on a busy machine: its bag is whole all the same."""

import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import rclpy
from mcap.reader import make_reader
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, ros, running, wait_for
from std_msgs.msg import Header

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.nodes.recorder import AHEAD_NS
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep

LOOPS = ("observer", "controller", "driver")
LOCKSTEP = ("-p", "use_sim_time:=true", "-p", "lockstep:=true", "-p", "scene:=free")
KEPT_TOPICS = ("/joint_states", "/effort_controller/commands", "/external_torque")
KEPT = topics.KEPT_STREAM.depth
"""Messages of a topic that wait for those who come late."""


@pytest.fixture
def domain():
    env = environment()
    with ros(domain=env["ROS_DOMAIN_ID"]):
        yield env


def test_time_waits_for_a_recorder_that_stands_still(domain, tmp_path):
    look = rclpy.create_node("look")
    promises = look.create_publisher(Header, topics.LOCKSTEP_HORIZON.name, qos_profile(topics.LOCKSTEP_HORIZON.qos))
    planner = Lockstep("planner", 0, promises.publish)
    stamps = [0]
    look.create_subscription(
        JointState,
        topics.JOINT_STATES.name,
        lambda state: stamps.append(nanoseconds(state.header.stamp)),
        qos_profile(topics.NEWEST),
    )

    def passed(duration_ns: int) -> bool:
        planner.promise(FOREVER_NS)
        rclpy.spin_once(look, timeout_sec=0.1)
        return stamps[-1] - began_ns >= duration_ns

    bag = tmp_path / "bag"
    with ExitStack() as stack:
        command = [*module("nodes.recorder"), "--ros-args", "-p", f"bag:={bag}", "-p", "use_sim_time:=true"]
        recorder = stack.enter_context(running(command, domain, tmp_path / "recorder.log"))
        for name in LOOPS:
            wanted = (*LOCKSTEP, "-p", "waits_for:=recorder") if name == "driver" else LOCKSTEP[:2]
            command = [*module(f"nodes.{name}"), "--ros-args", *wanted]
            stack.enter_context(running(command, domain, tmp_path / f"{name}.log"))
        began_ns = 0
        wait_for(lambda: passed(1), 60, "time begins")
        began_ns = stamps[-1]
        wait_for(lambda: passed(2 * AHEAD_NS), 60, "time passes")
        recorder.send_signal(signal.SIGSTOP)
        began_ns, end = stamps[-1], time.monotonic() + 5.0
        while time.monotonic() < end:
            assert not passed(2 * AHEAD_NS), "time does not wait"
        recorder.send_signal(signal.SIGCONT)
        wait_for(lambda: passed(4 * AHEAD_NS), 60, "time passes again")
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(30) == 0, (tmp_path / "recorder.log").read_text()
        began_ns = stamps[-1]
        wait_for(lambda: passed(2 * AHEAD_NS), 60, "time passes without a recorder")
    sequences = recorded_sequences(bag)
    for name in KEPT_TOPICS:
        assert sequences[name] == list(range(1, 1 + len(sequences[name]))), name


def test_seconds_of_ticks_are_in_the_bag(domain, tmp_path):
    """On a busy machine it takes that long until a recorder finds a topic."""
    look = rclpy.create_node("look")
    topic = topics.JOINT_STATES._replace(qos=topics.KEPT_STREAM)
    publisher = look.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
    for _ in range(KEPT):
        publisher.publish(JointState())
    bag = tmp_path / "bag"
    command = [*module("nodes.recorder"), "--ros-args", "-p", f"bag:={bag}"]
    with running(command, domain, tmp_path / "recorder.log") as recorder:
        wait_for(publisher.get_subscription_count, 60, "the recorder subscribes")
        assert publisher.wait_for_all_acked(Duration(seconds=60.0))
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(30) == 0, (tmp_path / "recorder.log").read_text()
    assert recorded_sequences(bag)["/joint_states"] == list(range(1, KEPT + 1))


def recorded_sequences(bag: Path) -> dict[str, list[int]]:
    """Numbers of the messages that a bag has, by topic."""
    (file,) = bag.glob("*.mcap")
    sequences: dict[str, list[int]] = {}
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            sequences.setdefault(channel.topic, []).append(message.sequence)
    return sequences
