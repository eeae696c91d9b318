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

LOCKSTEP = ("-p", "use_sim_time:=true")
DRIVER = (*LOCKSTEP, "-p", "lockstep:=true", "-p", "scene:=free", "-p", "waits_for:=recorder")
KEPT_TOPICS = ("/joint_states", "/effort_controller/commands", "/external_torque")


@pytest.fixture
def domain():
    env = environment()
    with ros(domain=env["ROS_DOMAIN_ID"]):
        yield env


def node(name, *arguments):
    return [*module(f"nodes.{name}"), "--ros-args", *arguments]


def stop(recorder):
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(30) == 0


def recorded_sequences(bag: Path) -> dict[str, list[int]]:
    """Numbers of the messages that a bag has, by topic."""
    (file,) = bag.glob("*.mcap")
    sequences: dict[str, list[int]] = {}
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            sequences.setdefault(channel.topic, []).append(message.sequence)
    return sequences


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

    def passed(duration_ns: int, since_ns: int) -> bool:
        planner.promise(FOREVER_NS)
        rclpy.spin_once(look, timeout_sec=0.1)
        return stamps[-1] - since_ns >= duration_ns

    def wait_for_time(duration_ns: int, what: str) -> None:
        began_ns = stamps[-1]
        wait_for(lambda: passed(duration_ns, began_ns), 60, what)

    bag = tmp_path / "bag"
    with ExitStack() as stack:
        recording = node("recorder", "-p", f"bag:={bag}", *LOCKSTEP)
        recorder = stack.enter_context(running(recording, domain, tmp_path / "recorder.log"))
        for name, arguments in (("observer", LOCKSTEP), ("controller", LOCKSTEP), ("driver", DRIVER)):
            stack.enter_context(running(node(name, *arguments), domain, tmp_path / f"{name}.log"))
        wait_for(lambda: passed(1, 0), 60, "time begins")
        wait_for_time(2 * AHEAD_NS, "time passes")
        recorder.send_signal(signal.SIGSTOP)
        began_ns, end = stamps[-1], time.monotonic() + 2.0
        while time.monotonic() < end:
            assert not passed(2 * AHEAD_NS, began_ns), "time does not wait"
        recorder.send_signal(signal.SIGCONT)
        wait_for_time(4 * AHEAD_NS, "time passes again")
        stop(recorder)
        wait_for_time(2 * AHEAD_NS, "time passes without a recorder")
    sequences = recorded_sequences(bag)
    for name in KEPT_TOPICS:
        assert sequences[name] == list(range(1, 1 + len(sequences[name]))), name


def test_seconds_of_ticks_are_in_the_bag(domain, tmp_path):
    """On a busy machine it takes that long until a recorder finds a topic."""
    topic, kept, bag = topics.JOINT_STATES, topics.KEPT_STREAM.depth, tmp_path / "bag"
    publisher = rclpy.create_node("look").create_publisher(topic.type, topic.name, qos_profile(topics.KEPT_STREAM))
    for _ in range(kept):
        publisher.publish(JointState())
    with running(node("recorder", "-p", f"bag:={bag}"), domain, tmp_path / "recorder.log") as recorder:
        wait_for(publisher.get_subscription_count, 60, "the recorder subscribes")
        assert publisher.wait_for_all_acked(Duration(seconds=60.0))
        stop(recorder)
    assert recorded_sequences(bag)["/joint_states"] == list(range(1, kept + 1))
