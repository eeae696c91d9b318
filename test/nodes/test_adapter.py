"""The adapter between controller and drive: order of joints, refusals, lockstep, and a controller that is killed."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST, TICK_NS
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import hand_in, ros
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.adapter_settings import EffortSettings
from contact_reach_ros.drives import effort
from contact_reach_ros.drives.effort import EffortTarget
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.serialized import CommandWriter, JointStateWriter
from contact_reach_ros.nodes.adapter import AdapterNode

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
        hand_in(self.node.inbox, topics.JOINT_STATES, self._states.write(tick * TICK_NS, HOME, REST))

    def command(self, torque=TORQUE):
        hand_in(self.node.inbox, topics.ADAPTER_COMMANDS, self._commands.write(torque))

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
        hand_in(bench.node.inbox, topics.SETTINGS, serialize_message(settings))
        bench.command()
        assert len(bench.sent) == count
    assert "gravity_compensation = False in the controller" in bench.node.boundary.last_refusals()[-1]


@pytest.mark.parametrize("bench", [SIMPLE], indirect=True)
def test_a_second_commander_stops_it_until_it_has_gone(bench):
    bench.state()
    bench.command()
    others = [rclpy.create_node(name, use_global_arguments=False) for name in ("controller", "intruder")]
    rivals = [other.create_publisher(Float64MultiArray, topics.ADAPTER_COMMANDS.name, 1) for other in others]
    bench.until(lambda: bench.node.rivals)
    bench.node.inbox.run_tasks()
    assert bench.node.diagnosis()[0].startswith("2 publishers on /adapter/commands (/controller, /intruder)")
    bench.command()
    assert len(bench.sent) == 1
    others[1].destroy_publisher(rivals[1])
    bench.until(lambda: not bench.node.rivals)
    bench.state(2)
    bench.node.reset()
    bench.command()
    # A harmless torque for the state that came while it was stopped, and the command.
    assert len(bench.sent) == 3


@pytest.mark.parametrize("bench", [LOCKSTEP], indirect=True)
def test_in_lockstep_silence_is_measured_by_the_states(bench):
    bench.state(1)
    bench.command()
    for tick in range(2, 130):
        bench.state(tick)
    assert bench.node._guard.stop_reason.startswith("no command for")
    # One harmless torque for each state after the silence of 20 ms.
    assert len(bench.sent) == 1 + 129 - 21
    np.testing.assert_allclose(bench.sent[-1], RobotModel(ARM).gravity_at(HOME))


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
