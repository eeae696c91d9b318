"""Replaying: what is published, under which names, and how it is steered."""

import signal
import subprocess
import threading
from pathlib import Path

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, wait_for
from std_msgs.msg import Float64MultiArray, String

from contact_reach_ros.bags.topics import OfferedQos, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.replay import main, publisher_qos

PATIENCE = 60.0
MS = 1_000_000
START = 1_700_000_000_000_000_000
LATCHED = OfferedQos(depth=3, durability="transient_local")
BEST = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
BEST_EFFORT = OfferedQos(reliability="best_effort")
TOPICS = (
    RecordedTopic("/robot_description", "std_msgs/msg/String", (LATCHED,)),
    RecordedTopic("/joint_states", "sensor_msgs/msg/JointState", (OfferedQos(depth=1000),)),
    RecordedTopic("/effort_controller/commands", "std_msgs/msg/Float64MultiArray", (BEST_EFFORT,)),
)
TICKS = 200


def make_bag(directory: Path) -> dict[str, list[bytes]]:
    """A recording of 0.4 s; returns the messages by topic."""
    written: dict[str, list[bytes]] = {topic.name: [] for topic in TOPICS}

    with BagWriter(directory, TOPICS) as writer:

        def write(name: str, message: object, at_ms: float) -> None:
            written[name].append(serialize_message(message))
            writer.write(name, written[name][-1], START + int(at_ms * MS))

        write("/robot_description", String(data="<robot/>"), 0)
        for tick in range(TICKS):
            write("/joint_states", JointState(name=["a"], position=[float(tick)]), 2 * tick + 1)
            write("/effort_controller/commands", Float64MultiArray(data=[float(tick)]), 2 * tick + 1.5)
    return written


def decoded(messages: list[bytes], kind: type) -> list[object]:
    """For comparison: on its way a message is padded."""
    return [deserialize_message(message, kind) for message in messages]


COMMANDS, STATES = "/effort_controller/commands", "/joint_states"


def replay(*arguments: object) -> list[str]:
    return [*module("nodes.replay"), *map(str, arguments)]


class Listener:
    """A node beside a replay, spinning in a thread."""

    def __init__(self, env: dict[str, str], name: str = "listener") -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=int(env["ROS_DOMAIN_ID"]))
        self.node: Node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin)
        self._thread.start()

    def hear(self, kind: type, topic: str, qos: QoSProfile) -> list[bytes]:
        heard: list[bytes] = []
        self.node.create_subscription(kind, topic, heard.append, qos, raw=True)
        return heard

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def env():
    return environment()


@pytest.fixture
def listener(env):
    made = Listener(env)
    yield made
    made.close()


def test_bag_is_published_as_it_was_where_no_live_arm_hears_it(tmp_path, env, listener):
    written = make_bag(tmp_path / "bag")
    states = listener.hear(JointState, f"/replay{STATES}", QoSProfile(depth=10_000))
    commands = listener.hear(Float64MultiArray, f"/own{COMMANDS}", BEST)
    latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    descriptions = listener.hear(String, "/replay/robot_description", latched)
    remapping = ("--ros-args", "-r", f"/replay{COMMANDS}:=/own{COMMANDS}")
    command = replay(tmp_path / "bag", "--loop", "--rate", 2, *remapping)
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        wait_for(lambda: len(states) > 3 * TICKS and commands, PATIENCE, "more than two rounds")
        # Not even as a second publisher, for which nodes would stop the arm.
        assert not any(map(listener.node.count_publishers, [topic.name for topic in TOPICS]))
        (offered,) = listener.node.get_publishers_info_by_topic("/replay/robot_description")
        assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output and "messages of 3 topics" in output
    heard = decoded(states, JointState)
    first = next(row for row, state in enumerate(heard) if state.position[0] == 0.0)
    assert heard[first : first + TICKS] == decoded(written[STATES], JointState)
    assert decoded(descriptions[-1:], String) == decoded(written["/robot_description"], String)


def test_a_replay_ends_with_the_bag(tmp_path, env):
    make_bag(tmp_path / "bag")
    ended = subprocess.run(
        replay(tmp_path / "bag", "--topics", "joint_states", "--start", 0.2), env=env, capture_output=True, text=True
    )
    assert ended.returncode == 0 and f"{TICKS // 2} messages of 1 topics" in ended.stdout, ended


def test_quality_of_service_is_the_best_that_was_offered():
    profile = publisher_qos("/a", (BEST_EFFORT, LATCHED))
    assert profile.reliability == ReliabilityPolicy.RELIABLE
    assert profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert profile.depth >= LATCHED.depth
    assert publisher_qos("/a", (BEST_EFFORT,)).reliability == ReliabilityPolicy.BEST_EFFORT


def test_depth_that_discovery_does_not_tell_is_that_of_the_stack():
    unknown = OfferedQos(history="unknown", depth=0)
    latched = OfferedQos(history="unknown", depth=0, durability="transient_local")
    assert publisher_qos("/left/joint_states", (unknown,)).depth == topics.JOINT_STATES.qos.depth
    assert publisher_qos("/safety_state", (latched,)).depth == topics.SAFETY_STATE.qos.depth
    assert publisher_qos("/map", (latched,)).depth == 1
    assert publisher_qos("/scan", (unknown,)).depth > 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate", "0"], "--rate 0: expected 0.01 to 100"),
        (["--start", "9"], "--start 9: expected 0 to 0.400 s"),
        (["--topics", "nothing"], "no such topic; it has /effort_controller/commands, /joint_states"),
        (["--ros-args", "-r", "no rule"], "ROS refused the arguments"),
    ],
)
def test_bad_options_are_one_line(tmp_path, capsys, arguments, message):
    make_bag(tmp_path / "bag")
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "bag"), *arguments])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
