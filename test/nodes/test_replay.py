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
from std_srvs.srv import SetBool

from contact_reach_ros.bags.topics import OfferedQos, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.bag_publisher import publisher_qos
from contact_reach_ros.nodes.replay import main

PATIENCE = 60.0
MS = 1_000_000
START = 1_700_000_000_000_000_000
LATCHED = OfferedQos(depth=3, durability="transient_local")
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

    def call(self, kind: type, name: str, request: object) -> object:
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        wait_for(future.done, PATIENCE, name)
        return future.result()

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
    deep = QoSProfile(depth=1000)
    latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    states = listener.hear(JointState, "/replay/joint_states", deep)
    descriptions = listener.hear(String, "/replay/robot_description", latched)
    live = listener.hear(JointState, "/joint_states", deep)
    output = (tmp_path / "output").open("w+")
    names = ("--topics", "joint_states", "/robot_description")
    arguments = (tmp_path / "bag", *names, "--paused")
    process = subprocess.Popen(replay(*arguments), env=env, stdout=output, stderr=output)
    try:
        published = ("/replay/joint_states", "/replay/robot_description")
        wait_for(lambda: all(map(listener.node.count_publishers, published)), PATIENCE, "publishers")
        (offered,) = listener.node.get_publishers_info_by_topic("/replay/robot_description")
        assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        # Not even as a second publisher, for which nodes would stop the arm.
        assert not any(map(listener.node.count_publishers, [topic.name for topic in TOPICS]))
        assert listener.call(SetBool, "/replay/pause", SetBool.Request(data=False)).message == "playing"
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.wait()
    assert decoded(states, JointState) == decoded(written["/joint_states"], JointState)
    assert decoded(descriptions, String) == decoded(written["/robot_description"], String)
    assert not live
    output.seek(0)
    assert f"{TICKS + 1} messages of 2 topics" in output.read()


def test_signal_ends_an_endless_replay_cleanly(tmp_path, env, listener):
    make_bag(tmp_path / "bag")
    states = listener.hear(JointState, "/replay/joint_states", QoSProfile(depth=1000))
    arguments = (tmp_path / "bag", "--topics", "joint_states", "--loop", "--rate", 10, "--start", 0.2)
    process = subprocess.Popen(replay(*arguments), env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        wait_for(lambda: len(states) > 2 * TICKS, PATIENCE, "more than two rounds")
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output
    assert "times" in output


def test_a_remapping_gives_a_topic_its_recorded_name(tmp_path, env, listener):
    written = make_bag(tmp_path / "bag")
    states = listener.hear(JointState, STATES, QoSProfile(depth=1000))
    remapping = ("--paused", "--ros-args", "-r", f"/replay{STATES}:={STATES}")
    process = subprocess.Popen(replay(tmp_path / "bag", *remapping), env=env, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: listener.node.count_publishers(STATES), PATIENCE, "a publisher")
        assert listener.call(SetBool, "/replay/pause", SetBool.Request(data=False)).success
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, errors
    finally:
        process.kill()
    assert decoded(states, JointState) == decoded(written[STATES], JointState)


def test_quality_of_service_is_the_best_that_was_offered():
    profile = publisher_qos("/a", (BEST_EFFORT, LATCHED))
    assert profile.reliability == ReliabilityPolicy.RELIABLE
    assert profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert profile.depth == BEST_EFFORT.depth
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
