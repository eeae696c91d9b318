"""Replaying: what is published, under which names, and how it is steered."""

import dataclasses
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

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.replay import choose_topics, main, publisher_qos

MS, START, TICKS = 1_000_000, 1_700_000_000_000_000_000, 200
COMMANDS, STATES, DESCRIPTION = "/effort_controller/commands", "/joint_states", "/robot_description"
TOPICS = (
    RecordedTopic(DESCRIPTION, "std_msgs/msg/String", latched=True),
    RecordedTopic(STATES, "sensor_msgs/msg/JointState"),
    RecordedTopic(COMMANDS, "std_msgs/msg/Float64MultiArray"),
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


@pytest.mark.parametrize(
    ("name", "is_latched", "depth"),
    [
        ("/left/joint_states", False, topics.JOINT_STATES.qos.depth),
        ("/safety_state", True, topics.SAFETY_STATE.qos.depth),
        ("/map", True, 1),
        ("/scan", False, topics.STREAM.depth),
    ],
)
def test_everybody_hears_as_much_as_from_the_stack(name, is_latched, depth):
    topic = RecordedTopic(name, "std_msgs/msg/String", latched=is_latched)
    assert publisher_qos(topic) == topics.Qos(depth, reliable=True, latched=is_latched)


def test_a_type_that_is_not_installed_is_left_out(bag, capsys):
    reader = BagReader(bag)
    reader.topics[STATES] = dataclasses.replace(reader.topics[STATES], type="arm_msgs/msg/Gain")
    assert set(choose_topics(reader, None)) == {DESCRIPTION, COMMANDS}
    assert "/joint_states is left out: it has cdr of arm_msgs/msg/Gain, expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate", "0"], "--rate 0: expected 0.01 to 100"),
        (["--start", "9"], "--start 9: expected 0 to 0.400 s"),
        (["--start", "0.35", "--loop"], "--loop: 0.050 s are left to replay; expected at least 0.1 s"),
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
