"""Replaying: what is published, under which names, and how it is steered."""

import signal
import subprocess
from pathlib import Path

import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, ros
from std_msgs.msg import Float64MultiArray, String

from contact_reach_ros.bags.topics import OfferedQos, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.replay import main, publisher_qos

MS, START, TICKS = 1_000_000, 1_700_000_000_000_000_000, 200
LATCHED, BEST_EFFORT = OfferedQos(depth=3, durability="transient_local"), OfferedQos(reliability="best_effort")
COMMANDS, STATES, DESCRIPTION = "/effort_controller/commands", "/joint_states", "/robot_description"
TOPICS = (
    RecordedTopic(DESCRIPTION, "std_msgs/msg/String", (LATCHED,)),
    RecordedTopic(STATES, "sensor_msgs/msg/JointState", (OfferedQos(depth=1000),)),
    RecordedTopic(COMMANDS, "std_msgs/msg/Float64MultiArray", (BEST_EFFORT,)),
)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A recording of 0.4 s."""
    folder = tmp_path_factory.mktemp("recorded") / "bag"
    with BagWriter(folder, TOPICS) as writer:
        writer.write(DESCRIPTION, serialize_message(String(data="<robot/>")), START)
        for tick in range(TICKS):
            state = JointState(name=["a"], position=[float(tick)])
            writer.write(STATES, serialize_message(state), START + (2 * tick + 1) * MS)
            command = Float64MultiArray(data=[float(tick)])
            writer.write(COMMANDS, serialize_message(command), START + (2 * tick + 1) * MS + MS // 2)
    return folder


def test_bag_is_published_as_it_was_where_no_live_arm_hears_it(bag):
    env, heard = environment(), {}
    latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    best_effort = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    with ros(domain=env["ROS_DOMAIN_ID"]):
        listener = rclpy.create_node("listener")
        for kind, topic, qos in (
            (JointState, f"/replay{STATES}", QoSProfile(depth=10_000)),
            (Float64MultiArray, f"/own{COMMANDS}", best_effort),
            (String, f"/replay{DESCRIPTION}", latched),
        ):
            heard[topic] = []
            listener.create_subscription(kind, topic, heard[topic].append, qos)
        states, commands, descriptions = heard.values()
        command = [*module("nodes.replay"), str(bag), "--loop", "--rate", "2", "--ros-args"]
        command += ["-r", f"/replay{COMMANDS}:=/own{COMMANDS}"]
        process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            while len(states) <= 3 * TICKS or not commands:
                assert process.poll() is None
                rclpy.spin_once(listener, timeout_sec=1.0)
            # Not even as a second publisher, for which nodes would stop the arm.
            assert not any(map(listener.count_publishers, [topic.name for topic in TOPICS]))
            (offered,) = listener.get_publishers_info_by_topic(f"/replay{DESCRIPTION}")
            assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            process.send_signal(signal.SIGTERM)
            output, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0 and "Traceback" not in output and "messages of 3 topics" in output, output
    first = next(row for row, state in enumerate(states) if state.position[0] == 0.0)
    assert [state.position[0] for state in states[first : first + TICKS]] == list(range(TICKS))
    assert descriptions[-1].data == "<robot/>"


@pytest.mark.usefixtures("signal_handlers")
def test_a_replay_ends_with_the_bag(bag, capsys):
    main([str(bag), "--topics", "joint_states", "--start", "0.2"])
    assert f"{TICKS // 2} messages of 1 topics" in capsys.readouterr().out


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
def test_bad_options_are_one_line(bag, capsys, arguments, message):
    with pytest.raises(SystemExit) as ended:
        main([str(bag), *arguments])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
