"""Replaying: what is published, how it is steered, and where it is refused."""

import signal
import subprocess
import threading
from pathlib import Path

import pytest
import rclpy
from mcap.writer import Writer
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from stack_helpers import environment, module, wait_for
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from contact_reach_ros.bags.topics import OfferedQos, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.bag_publisher import publisher_qos
from contact_reach_ros.nodes.replay import main
from contact_reach_ros.ros.replay_guard import Endpoints, Guard, signs_of_a_stack

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


def test_bag_is_published_as_it_was_and_steered_by_services(tmp_path, env, listener):
    written = make_bag(tmp_path / "bag")
    deep = QoSProfile(depth=1000)
    latched = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    states = listener.hear(JointState, "/joint_states", deep)
    descriptions = listener.hear(String, "/robot_description", latched)
    output = (tmp_path / "output").open("w+")
    names = ("--topics", "joint_states", "/robot_description")
    arguments = (tmp_path / "bag", *names, "--paused", "--json", tmp_path / "json")
    process = subprocess.Popen(replay(*arguments), env=env, stdout=output, stderr=output)
    try:
        published = ("/joint_states", "/robot_description")
        wait_for(lambda: all(map(listener.node.count_publishers, published)), PATIENCE, "publishers")
        (offered,) = listener.node.get_publishers_info_by_topic("/robot_description")
        assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        for count in (1, 2):
            assert listener.call(Trigger, "/replay/step", Trigger.Request()).success
            wait_for(lambda count=count: len(states) == count, PATIENCE, f"{count} states")
        assert decoded(descriptions, String) == decoded(written["/robot_description"], String)
        assert listener.call(SetBool, "/replay/pause", SetBool.Request(data=False)).message == "playing"
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.wait()
    assert decoded(states, JointState) == decoded(written["/joint_states"], JointState)
    output.seek(0)
    assert f"{TICKS + 1} messages of 2 topics" in output.read()
    assert f'"messages": {TICKS + 1}' in (tmp_path / "json").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_an_endless_replay_cleanly(tmp_path, env, listener, number):
    make_bag(tmp_path / "bag")
    states = listener.hear(JointState, "/joint_states", QoSProfile(depth=1000))
    times: list[int] = []
    listener.node.create_subscription(Clock, "/clock", lambda message: times.append(message.clock.sec), 10)
    arguments = (tmp_path / "bag", "--topics", "joint_states", "--loop", "--rate", 10, "--start", 0.2, "--clock")
    process = subprocess.Popen(replay(*arguments), env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        wait_for(lambda: len(states) > 2 * TICKS and times, PATIENCE, "more than two rounds")
        process.send_signal(number)
        output, _ = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 0, output
    assert "Traceback" not in output
    assert "times" in output
    assert set(times) == {START // 1_000_000_000}


@pytest.mark.parametrize(
    "chosen", [[], ["--everything"], ["--topics", "effort_controller/commands"]], ids=lambda c: " ".join(c[:1])
)
def test_nothing_is_replayed_beside_a_live_arm(tmp_path, env, chosen):
    make_bag(tmp_path / "bag")
    arm = Listener(env, "my_arm")
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    arm.hear(Float64MultiArray, "/effort_controller/commands", newest)
    try:
        result = subprocess.run(
            replay(tmp_path / "bag", *chosen), env=env, capture_output=True, text=True, timeout=PATIENCE
        )
        assert result.returncode == 2
        *_, line = result.stderr.splitlines()
        assert "an arm could move" in line
        assert "/effort_controller/commands is heard by /my_arm" in line
        assert "--allow-motion" in line
        # It must not even appear as a second publisher, for which a driver would stop its arm.
        for name in ("/effort_controller/commands", "/joint_states"):
            assert arm.node.count_publishers(name) == 0
    finally:
        arm.close()


def test_commands_are_left_out_unless_they_are_asked_for(tmp_path, env):
    make_bag(tmp_path / "bag")
    watching = Listener(env, "recorder")
    commands = watching.hear(Float64MultiArray, "/effort_controller/commands", QoSProfile(depth=1000))
    try:
        result = subprocess.run(replay(tmp_path / "bag"), env=env, capture_output=True, text=True, timeout=PATIENCE)
        assert result.returncode == 0, result.stderr
        assert f"{TICKS + 1} messages of 2 topics" in result.stdout
        assert "left out, use --everything or --topics: /effort_controller/commands" in result.stderr
        assert not commands
    finally:
        watching.close()


def test_bag_of_nothing_but_commands_says_what_publishes_them(tmp_path, capsys):
    with BagWriter(tmp_path / "bag", TOPICS[2:]) as writer:
        writer.write(COMMANDS, serialize_message(Float64MultiArray(data=[0.0])), START)
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "bag")])
    assert ended.value.code == 2
    assert "--everything publishes commands, references and goals" in capsys.readouterr().err


def test_no_message_goes_to_an_arm_found_too_late_to_be_looked_at(env, listener):
    arm = Listener(env, "my_arm")
    kind, name = Float64MultiArray, COMMANDS
    try:
        guard = Guard(listener.node, [name])
        publisher = listener.node.create_publisher(kind, name, 1)
        guard.admit(name, publisher)
        arm.hear(kind, name, QoSProfile(depth=1))
        wait_for(publisher.get_subscription_count, PATIENCE, "a match")
        with pytest.raises(InputError, match=f"{name} is heard by /my_arm"):
            guard.admit(name, publisher)
    finally:
        arm.close()


def test_whoever_only_watches_gets_messages(env, listener):
    watching = Listener(env, "recorder")
    try:
        guard = Guard(listener.node, [COMMANDS])
        publisher = listener.node.create_publisher(Float64MultiArray, COMMANDS, 1)
        watching.hear(Float64MultiArray, COMMANDS, QoSProfile(depth=1))
        wait_for(publisher.get_subscription_count, PATIENCE, "a match")
        guard.admit(COMMANDS, publisher)
    finally:
        watching.close()


def nodes(*names: str) -> frozenset[str]:
    return frozenset(f"/{name}" for name in names)


COMMANDS, STATES, GOAL = "/effort_controller/commands", "/joint_states", "/goal_pose"


@pytest.mark.parametrize(
    ("name", "publishers", "listeners", "expected"),
    [
        (COMMANDS, ["controller"], ["driver", "observer"], "commands is heard by /driver"),
        (COMMANDS, ["controller"], ["observer"], "commands is published by /controller"),
        (STATES, ["driver"], ["observer"], "joint_states is published by /driver"),
        (STATES, [], ["controller", "observer", "planner"], "joint_states is heard by /controller, /planner"),
        (GOAL, ["viewer"], ["planner"], "goal_pose is heard by /planner"),
        ("/obstacles", [], ["planner"], "obstacles is heard by /planner"),
        ("/left/goal_pose", [], ["left/planner"], "/left/planner"),
        # Unknown nodes, by what they do.
        (COMMANDS, [], ["lbr/hardware"], "/lbr/hardware"),
        ("/reference/pose", ["my_planner"], [], "/my_planner"),
        ("/sim/faults", [], ["my_simulation"], "/my_simulation"),
        # Those that only watch.
        (COMMANDS, [], ["observer", "recorder"], ""),
        (STATES, [], ["rviz2", "observer"], ""),
        (GOAL, ["rviz2"], ["viewer"], ""),
        ("/external_torque", ["observer"], ["rviz2"], ""),
    ],
)
def test_what_shows_that_a_stack_runs(name, publishers, listeners, expected):
    found = "; ".join(signs_of_a_stack({name: Endpoints(nodes(*publishers), nodes(*listeners))}))
    assert expected in found
    assert bool(found) == bool(expected)


def test_a_stack_that_starts_during_a_replay_ends_it(env, listener):
    driver = Listener(env, "my_driver")
    try:
        guard = Guard(listener.node, ["/robot_description"])
        driver.node.create_publisher(JointState, "/left/joint_states", 1)
        wait_for(lambda: listener.node.count_publishers("/left/joint_states"), PATIENCE, "a publisher")

        def is_refused() -> bool:
            try:
                guard.check_next()
            except InputError as error:
                return "/left/joint_states is published by /my_driver" in str(error)
            return False

        wait_for(is_refused, PATIENCE, "a refusal")
    finally:
        driver.close()


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
        (["--clock", "0"], "--clock 0: expected 1 to 1000 Hz"),
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


def test_bag_of_unknown_types_says_which(tmp_path, capsys):
    path = tmp_path / "strange.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema("strangers_msgs/msg/Thing", "ros2msg", b"int32 a\n")
        writer.add_message(writer.register_channel("/thing", "cdr", schema), 1, b"\0\1\0\0\1\0\0\0", 1)
        writer.finish()
    with pytest.raises(SystemExit) as ended:
        main([str(path)])
    assert ended.value.code == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "/thing is left out: message type 'strangers_msgs/msg/Thing' is not installed" in first
    assert "no topic that can be published" in second
