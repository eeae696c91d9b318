"""The recorder as users start it: a process of its own, ended by a signal."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_domains import fresh_domain
from sensor_msgs.msg import JointState
from stack_helpers import ros
from std_msgs.msg import Float64MultiArray, String

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.settings import RecorderSettings
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.nodes.recorder import RecorderNode, TopicRecorder

PATIENCE = 60.0
"""How long a test waits for another process before it fails, s."""

RELIABLE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


class Recorder:
    """A recorder process on a domain of its own, and a node beside it that publishes."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.domain = fresh_domain()
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=self.domain)
        self.node: Node = rclpy.create_node("publisher", context=self._context)
        self.process: Any = None

    def start(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "contact_reach_ros.nodes.recorder", "--ros-args"]
        for argument in (f"bag:={self.directory}", *arguments):
            command += ["-p", argument]
        environment = {**os.environ, "ROS_DOMAIN_ID": str(self.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def end(self, number: int) -> tuple[int, str]:
        """Exit code and output."""
        self.process.send_signal(number)
        output, _ = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, output

    def until(self, holds: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not holds():
            assert time.monotonic() < deadline, f"still waiting for {what}"
            assert self.process is None or self.process.poll() is None
            time.sleep(0.01)

    def publisher(self, message_class: type, topic: str, qos: QoSProfile, wait: bool = True) -> Publisher:
        """A publisher that the recorder already listens to."""
        publisher = self.node.create_publisher(message_class, topic, qos)
        if wait:
            self.until(publisher.get_subscription_count, f"a subscription to {topic}")
        return publisher

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    made = Recorder(tmp_path / "bag")
    yield made
    made.close()


def acknowledged(*publishers: Publisher) -> None:
    """All messages have reached the recorder."""
    for publisher in publishers:
        assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE))


def test_everything_published_is_in_the_bag(recorder: Recorder) -> None:
    latched = recorder.publisher(String, "robot_description", LATCHED, wait=False)
    latched.publish(String(data="<robot/>"))
    parameters = recorder.directory.with_name("parameters.yaml")
    parameters.write_text("planner: {}\n# γ\n")
    recorder.start("custom_data:=[scene=ball, 'note=a=b']", f"files:=[parameter_file={parameters}]")
    states = recorder.publisher(JointState, "joint_states", RELIABLE)
    commands = recorder.publisher(Float64MultiArray, "effort_controller/commands", RELIABLE)
    recorder.until(latched.get_subscription_count, "a subscription to the latched topic")
    for name in ("chatter", "goal/state"):
        recorder.publisher(String, name, RELIABLE, wait=False).publish(String(data="not of the stack"))
    for count in range(600):
        states.publish(JointState(name=["lbr_A1"], position=[float(count)], velocity=[0.0], effort=[0.0]))
        commands.publish(Float64MultiArray(data=[float(-count)]))
        if count == 300:
            # A topic that appears while the recording runs.
            goals = recorder.publisher(PoseStamped, "goal_pose", RELIABLE)
            goals.publish(PoseStamped())
    acknowledged(latched, states, commands, goals)
    exit_code, output = recorder.end(signal.SIGINT)
    assert exit_code == 0, output
    assert "Traceback" not in output
    assert str(recorder.directory) in output
    assert output.count("what is published on '/goal/state' is no diagnostic_msgs/msg/DiagnosticStatus") == 1
    # Its own diagnostics, once a second, come on top of the 1202.
    assert re.search(r"recorded 1[23]\d\d messages \(0 lost\)", output)

    reader = BagReader(recorder.directory)
    assert reader.notes == ()
    # What a stack that has just ended in this domain offered is still known to the middleware for a while.
    counts = {name: topic.message_count for name, topic in reader.topics.items() if topic.message_count}
    counts.pop("/diagnostics", None)
    assert any("recording to" in line.msg for line in reader.messages("/rosout")) and counts.pop("/rosout")
    once = dict.fromkeys(("/robot_description", "/goal_pose", "/settings"), 1)
    assert counts == {"/joint_states": 600, "/effort_controller/commands": 600, **once}
    positions = [state.position[0] for state in reader.messages("/joint_states")]
    assert positions == [float(count) for count in range(600)]
    (description,) = reader.messages("/robot_description")
    assert description.data == "<robot/>"
    for raw in reader.raw_messages():
        assert 0 < raw.publish_time_ns <= raw.log_time_ns
    kept = reader.custom_data
    assert [reader.topics[name].latched for name in ("/robot_description", "/joint_states")] == [True, False]
    assert {key: kept[key] for key in ("scene", "note", "messages_lost", "parameter_file")} == {
        "scene": "ball",
        "note": "a=b",
        "messages_lost": "0",
        "parameter_file": "planner: {}\n# γ\n",
    }
    assert yaml.safe_load(kept["versions"])["rmw"] == rclpy.get_rmw_implementation_identifier()


def test_publisher_that_offers_less_is_heard_as_well(recorder: Recorder) -> None:
    with BagWriter(recorder.directory) as writer:
        topics = TopicRecorder(recorder.node, writer)
        reliable = recorder.publisher(JointState, "joint_states", LATCHED, wait=False)
        recorder.until(lambda: topics.discover() or reliable.get_subscription_count(), "a subscription")
        reliable.publish(JointState(name=["reliable"]))
        acknowledged(reliable)
        best_effort = recorder.publisher(JointState, "joint_states", BEST_EFFORT, wait=False)
        recorder.until(lambda: topics.discover() or best_effort.get_subscription_count(), "another request")
        # Best effort may lose single messages; some of several get through.
        for _ in range(20):
            best_effort.publish(JointState(name=["best effort"]))
        recorder.until(lambda: topics.drain() or writer.message_count > 1, "messages")
    read = BagReader(recorder.directory).messages("/joint_states")
    assert {state.name[0] for state in read} == {"reliable", "best effort"}


def test_what_others_publish_is_recorded_whatever_its_type(recorder: Recorder, capfd) -> None:
    frames = recorder.publisher(TransformStamped, "/tf_static", LATCHED, wait=False)
    frames.publish(TransformStamped(child_frame_id="camera"))
    moving = recorder.publisher(TransformStamped, "/tf", RELIABLE, wait=False)
    with BagWriter(recorder.directory) as writer:
        topics = TopicRecorder(recorder.node, writer)
        recorder.until(lambda: topics.discover() or moving.get_subscription_count(), "a subscription to /tf")
        moving.publish(TransformStamped(child_frame_id="tool"))
        recorder.node.get_logger().info("a line")
        recorder.until(lambda: topics.drain() or writer.message_count > 2, "messages")
        topics.stop()
    reader = BagReader(recorder.directory)
    assert {name: topic.type for name, topic in reader.topics.items()} == {
        "/tf": "geometry_msgs/msg/TransformStamped",
        "/tf_static": "geometry_msgs/msg/TransformStamped",
        "/rosout": "rcl_interfaces/msg/Log",
    }
    assert [reader.topics[name].latched for name in ("/tf", "/tf_static")] == [False, True]
    assert [frame.child_frame_id for frame in reader.messages("/tf_static")] == ["camera"]
    assert [frame.child_frame_id for frame in reader.messages("/tf")] == ["tool"]
    assert [line.msg for line in reader.messages("/rosout")] == ["a line"]


def test_a_remapped_topic_keeps_its_name_in_the_bag(recorder: Recorder) -> None:
    rules = ["--ros-args", "-r", "goal_pose:=reach_goal"]
    node = rclpy.create_node("recorder", context=recorder.node.context, cli_args=rules)
    goals = recorder.publisher(PoseStamped, "reach_goal", RELIABLE, wait=False)
    with BagWriter(recorder.directory) as writer:
        topics = TopicRecorder(node, writer)
        recorder.until(lambda: topics.discover() or goals.get_subscription_count(), "a subscription")
        goals.publish(PoseStamped())
        recorder.until(lambda: topics.drain() or writer.message_count, "the goal")
    found = BagReader(recorder.directory).topics
    assert found["/goal_pose"].message_count == 1 and "/reach_goal" not in found


def test_killed_recorder_leaves_what_it_had_flushed(recorder: Recorder) -> None:
    recorder.start("custom_data:=[seed=5]")
    texts = recorder.publisher(String, "robot_description", RELIABLE)
    for count in range(50):
        texts.publish(String(data=str(count)))
    acknowledged(texts)

    def flushed() -> int:
        try:
            return BagReader(recorder.directory).topics["/robot_description"].message_count
        except (BagError, KeyError):
            return 0

    recorder.until(lambda: flushed() == 50, "the messages in the file")
    recorder.end(signal.SIGKILL)
    reader = BagReader(recorder.directory)
    assert [text.data for text in reader.messages("/robot_description")] == [str(count) for count in range(50)]
    assert reader.custom_data["seed"] == "5"
    assert len(reader.notes) == 1


def test_recording_ends_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: free)
    with ros(f"bag:={tmp_path / 'bag'}"):
        node = RecorderNode()
        node.trigger_configure()
        node.trigger_activate()
        node.turn()
        assert node.diagnosis()[0] == ""
        free = free._replace(free=900_000)
        deadline = time.monotonic() + PATIENCE
        while not node.diagnosis()[0] and time.monotonic() < deadline:
            node.turn()
        assert "not recording: 1 MB are free" in node.diagnosis()[0]
        # The stack goes on.
        node.turn()
        node.trigger_deactivate()
    assert BagReader(tmp_path / "bag").notes == ()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (RecorderSettings(custom_data=("seed",)), "parameter custom_data, entry 'seed': expected key=value"),
        (RecorderSettings(files=("a=/no/such/file",)), "entry 'a': /no/such/file cannot be read"),
    ],
)
def test_a_text_that_cannot_be_kept_is_named(settings: RecorderSettings, message: str) -> None:
    with pytest.raises(BagError, match=message):
        settings.texts()
