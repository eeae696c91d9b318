"""The adapter between controller and drive: order of joints, refusals, lockstep, and a controller that is killed."""

import os
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from plans import make_plan
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import UNWATCHED, environment, module, ros, running, wait_for
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.adapter_settings import EffortSettings
from contact_reach_ros.drives import effort
from contact_reach_ros.drives.effort import EffortTarget
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.plan_messages import to_references
from contact_reach_ros.messages.serialized import CommandWriter, JointStateWriter
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.resources import config_file
from contact_reach_ros.ros.lockstep import BEHIND_ADAPTER, CONTROLLER
from contact_reach_ros.ros.qos import qos_profile

ARM = load_arm("iiwa14")
NAMES = list(ARM.joint_names)
TORQUE = RobotModel(ARM).gravity_at(HOME) + np.arange(7)


class Bench:
    """An adapter whose loop runs when told to, and what it sends."""

    def __init__(self):
        self.node = AdapterNode()
        self.sent = []
        self.node._write = lambda data: self.sent.append(deserialize_message(data, Float64MultiArray).data.tolist())
        self._states = JointStateWriter(NAMES, ARM.base_frame, ["position", "velocity"])
        self._commands = CommandWriter(7)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)

    def state(self, tick=1):
        self.node.inbox.give(topics.JOINT_STATES, self._states.write(tick * TICK_NS, HOME, REST))

    def command(self, torque=TORQUE):
        self.node.inbox.give(topics.ADAPTER_COMMANDS, self._commands.write(torque))

    def answer(self, tick):
        header = Header(frame_id=BEHIND_ADAPTER)
        header.stamp.nanosec = tick * TICK_NS
        self.node.inbox.give(topics.LOCKSTEP_HORIZON, serialize_message(header))

    def until(self, condition):
        deadline = time.monotonic() + 10.0
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(0.05)


@pytest.fixture
def bench(request):
    with ros("--ros-args", *(part for argument in request.param for part in ("-p", argument))):
        yield Bench()


ASKING, SIMPLE = (), ("effort.ask_joints:=false",)
LOCKSTEP = (*SIMPLE, "use_sim_time:=true")


def effort_controller(bench, joints):
    """A node with the parameter of an effort controller of ros2_control."""
    node = rclpy.create_node("effort_controller", use_global_arguments=False)
    node.declare_parameter("joints", joints)
    bench.executor.add_node(node)
    return node


@pytest.mark.parametrize("bench", [ASKING], indirect=True)
def test_commands_are_put_into_the_order_of_the_controller_that_takes_them(bench):
    bench.state()
    bench.command()
    assert bench.sent == [] and bench.node.refused == {"commands": 1}
    assert "joints of effort_controller is not known yet" in bench.node.diagnosis()[0]
    order = [NAMES[index] for index in (2, 0, 1, 6, 5, 4, 3)]
    keep = effort_controller(bench, order)
    bench.until(lambda: not bench.node.diagnosis()[0])
    assert bench.node.diagnosis()[1]["joints"] == ", ".join(order)
    bench.command()
    assert bench.sent == [TORQUE[[2, 0, 1, 6, 5, 4, 3]].tolist()]
    del keep


@pytest.mark.parametrize("bench", [ASKING], indirect=True)
def test_joints_that_do_not_match_are_named_beside_the_arms_and_nothing_passes(bench):
    keep = effort_controller(bench, ["elbow", *NAMES[1:]])
    bench.until(lambda: "elbow" in bench.node.diagnosis()[0])
    assert all(name in bench.node.diagnosis()[0] for name in NAMES)
    bench.state()
    bench.command()
    assert bench.sent == [] and bench.node.refused == {"commands": 1}
    del keep


@pytest.mark.parametrize("bench", [SIMPLE], indirect=True)
def test_a_controller_that_counts_on_another_gravity_is_refused(bench):
    bench.state()
    bench.command()
    assert len(bench.sent) == 1
    for value, count in (("false", 1), ("true", 2)):
        entry = KeyValue(key="supervision.gravity_compensation", value=value)
        settings = DiagnosticStatus(name="controller", values=[entry])
        bench.node.inbox.give(topics.SETTINGS, serialize_message(settings))
        bench.command()
        assert len(bench.sent) == count
    assert "gravity_compensation = False in the controller" in bench.node.boundary.last_refusals()[-1]


@pytest.mark.parametrize("bench", [SIMPLE], indirect=True)
def test_a_second_commander_stops_it_until_it_has_gone(bench):
    bench.state()
    bench.command()
    others = [rclpy.create_node(name, use_global_arguments=False) for name in ("controller", "intruder")]
    rivals = [other.create_publisher(Float64MultiArray, topics.ADAPTER_COMMANDS.name, 1) for other in others]
    bench.until(lambda: bench.node._rivalry)
    bench.node.inbox.run_tasks()
    assert bench.node.diagnosis()[0].startswith("2 publishers on /adapter/commands (/controller, /intruder)")
    bench.command()
    assert len(bench.sent) == 1
    others[1].destroy_publisher(rivals[1])
    bench.until(lambda: not bench.node._rivalry)
    bench.state(2)
    bench.node._reset()
    bench.command()
    assert len(bench.sent) == 2


@pytest.mark.parametrize("bench", [LOCKSTEP], indirect=True)
def test_in_lockstep_each_answer_of_the_controller_becomes_one_to_the_driver(bench):
    answers = []
    bench.node._lockstep._publish_header = lambda header: answers.append((header.frame_id, header.stamp.nanosec))
    # The first state is repeated; it may be answered without a command, and then with one.
    bench.answer(1)
    bench.state(1)
    bench.state(1)
    bench.command()
    assert answers == [(CONTROLLER, TICK_NS)] and len(bench.sent) == 1
    # Whatever comes first, state or command, and also two of each.
    for tick in (2, 3):
        bench.state(tick)
    for count in (2, 3):
        bench.command()
        assert len(bench.sent) == count
    bench.command()
    assert len(bench.sent) == 3
    bench.state(4)
    assert len(bench.sent) == 4
    # Commands that cease: answers pass, then there are harmless torques instead, one for each.
    for tick in range(5, 130):
        bench.state(tick)
        bench.answer(tick)
    assert len(answers) == 1 + 20 and len(bench.sent) == 4 + 105
    np.testing.assert_allclose(bench.sent[-1], RobotModel(ARM).gravity_at(HOME))
    assert bench.node._guard.stop_reason.startswith("no command for")
    # One that is refused is answered, too.
    bench.state(130)
    bench.command(np.full(7, np.nan))
    assert len(bench.sent) == 4 + 106


@pytest.mark.parametrize("bench", [SIMPLE], indirect=True)
def test_deactivated_it_leaves_an_arm_at_rest_under_harmless_torques(bench):
    bench.node.trigger_configure()
    bench.node.trigger_activate()
    bench.state()
    bench.command()
    bench.node.trigger_deactivate()
    assert bench.node._guard.stop_reason == "the adapter is deactivated"
    np.testing.assert_allclose(bench.sent[-1], RobotModel(ARM).gravity_at(HOME))


class Switches:
    """Clients of a controller manager; keeps what it is asked for."""

    def __init__(self):
        self.asked, self.warnings = [], []

    def create_client(self, kind, name):
        return self if kind is _SwitchController else None

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def call_async(self, request):
        self.asked.append((request.activate_controllers, request.deactivate_controllers))
        return SimpleNamespace(add_done_callback=lambda callback: None)


class _SwitchController:
    class Request(SimpleNamespace):
        STRICT = 2
        activate_controllers = ()
        deactivate_controllers = ()


@pytest.mark.parametrize(
    ("carries", "brakes", "switches"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_a_stop_deactivates_the_controller_unless_the_arm_would_drop(carries, brakes, switches, monkeypatch):
    node = Switches()
    settings = EffortSettings(ask_joints=False, brakes=brakes)
    EffortTarget(node, ARM, settings, carries).stop()
    warned = [warning for warning in node.warnings if warning.startswith("controller_manager_msgs is not installed")]
    if effort.SwitchController is None:
        assert len(warned) == switches
    monkeypatch.setattr(effort, "SwitchController", _SwitchController)
    target = EffortTarget(node, ARM, settings, carries)
    target.stop()
    target.resume()
    both = [((), ["effort_controller"]), (["effort_controller"], ())]
    assert node.asked == (both if switches else [])


SHORT_LEASE = """<rtps>
        <builtin><discovery_config>
          <leaseDuration><sec>4</sec></leaseDuration><leaseAnnouncement><sec>1</sec></leaseAnnouncement>
        </discovery_config></builtin>"""
"""Whoever was killed leaves the graph after seconds; by default its successor would be its rival for 20 s."""
FAR = ["-p", "supervision.max_position_error:=1.0", "-p", "supervision.adapter:=true"]
TO_THE_SIDE = np.array([0.0, 0.15, 0.0])


class Operator:
    """Sends plans, calls services, and kills a process once the arm moves."""

    def __init__(self):
        self._node = rclpy.create_node("planner")
        self.q, self.speed, self.fastest, self.stop = None, 0.0, 0.0, ""
        self.victim = None
        self._node.create_subscription(JointState, topics.JOINT_STATES.name, self._on_state, 1)
        self._node.create_subscription(
            DiagnosticStatus, topics.SAFETY_STATE.name, self._on_safety, qos_profile(topics.ALL_EVENTS)
        )
        self._plans = [
            self._node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
            for topic in (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)
        ]

    def _on_state(self, message):
        self.q, self.speed = np.array(message.position), float(np.abs(message.velocity).max())
        self.fastest = max(self.fastest, self.speed)
        if self.victim is not None and self.speed > 0.2:
            os.kill(self.victim, signal.SIGKILL)
            self.victim = None

    def _on_safety(self, message):
        if message.name == "adapter":
            self.stop = message.message if message.level == DiagnosticStatus.ERROR else ""

    def spin(self, seconds):
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(self._node, timeout_sec=0.01)
        return True

    def until(self, condition, what):
        wait_for(lambda: self.spin(0.05) and condition(), 60, what)

    def move(self):
        """Plan to the side; again and again, since a controller takes plans only once it has started.

        On a busy machine commands may have been silent for long enough to stop the arm before.
        """
        if self.stop and not self.reset():
            return
        position, rotation = RobotModel(ARM).tip_pose(self.q)
        knots = 10
        plan = make_plan(
            np.tile(position + TO_THE_SIDE, (knots, 1)),
            np.tile(rotation, (knots, 1, 1)),
            np.tile(self.q, (knots, 1)),
            effect_ns=time.time_ns() + 20_000_000,
        )
        for publisher, message in zip(self._plans, to_references(plan, ARM), strict=True):
            publisher.publish(message)
        self.spin(0.5)

    def reset(self):
        client = self._node.create_client(Trigger, "adapter/reset")
        assert client.wait_for_service(20.0)
        answer = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self._node, answer, timeout_sec=10.0)
        return answer.done() and answer.result().success


def test_without_a_watchdog_in_the_drive_a_killed_controller_leaves_the_arm_at_rest_and_another_moves_it(tmp_path):
    profile = tmp_path / "short_lease.xml"
    profile.write_text(config_file("fastdds.xml").read_text().replace("<rtps>", SHORT_LEASE, 1))
    env = {**environment(), "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}
    drive = ["-p", "scene:=free", "-p", "watchdog.enabled:=false", "-p", "watchdog.speed_share:=0.0"]

    def start(name, *arguments):
        return running([*module(f"nodes.{name}"), "--ros-args", *arguments], env, tmp_path / f"{name}.log")

    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
        rclpy.init(domain_id=int(env["ROS_DOMAIN_ID"]))
    try:
        operator = Operator()
        with start("driver", *drive), start("adapter", "-p", "effort.ask_joints:=false"):
            with start("controller", *UNWATCHED[1:], *FAR) as controller:
                operator.until(lambda: operator.q is not None, "joint states")
                operator.victim = controller.pid
                operator.until(lambda: controller.poll() is not None or operator.move(), "the arm moves")
            killed_at = operator.q
            operator.until(lambda: operator.stop.startswith("no command for"), "the adapter stops")
            operator.until(lambda: operator.speed < 0.05, "the arm is at rest")
            resting_at = operator.q
            operator.spin(0.5)
            assert np.abs(resting_at - killed_at).max() < 0.3
            assert np.abs(operator.q - resting_at).max() < 0.02
            assert "brakes closed" not in (tmp_path / "driver.log").read_text()
            with start("controller", *UNWATCHED[1:], *FAR):
                operator.until(operator.reset, "the reset")
                assert operator.stop == ""
                operator.fastest = 0.0
                operator.until(lambda: operator.move() or operator.fastest > 0.2, "the arm moves again")
    finally:
        rclpy.shutdown()
        print(*(log.read_text() for log in tmp_path.glob("*.log")))
