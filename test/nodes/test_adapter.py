"""The adapter between controller and drive: order of joints, refusals, lockstep, and a controller that is killed."""

import time

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME, REST, TICK_NS
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import Beside, hand_in, ros
from std_msgs.msg import Float64MultiArray

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.drives.franka import FrankaTarget
from contact_reach_ros.drives.settings import FrankaSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.messages.serialized import command_writer, joint_state_writer
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.ros.inbox import qos_profile

ARM = load_arm("iiwa14")
NAMES = list(ARM.joint_names)
MODEL = RobotModel(ARM)
MODEL.update_dynamics(HOME)
GRAVITY = MODEL.gravity
TORQUE = GRAVITY + np.arange(7)


def held_energy(torque):
    """Energy of springs that pull with what a torque has beyond the weight; their stiffness is the mass matrix."""
    beyond = np.asarray(torque) - GRAVITY
    return beyond @ np.linalg.solve(MODEL.mass_matrix, beyond)


class Bench(Beside):
    """An adapter whose loop runs when told to, and what it sends."""

    def __init__(self):
        super().__init__(AdapterNode())
        self.sent = []
        self.node._write = lambda data: self.sent.append(deserialize_message(data, Float64MultiArray).data.tolist())
        self._states = joint_state_writer(NAMES, ARM.base_frame, ["position", "velocity"])
        self._commands = command_writer(7)

    def state(self, tick=1):
        hand_in(self.node.inbox, topics.JOINT_STATES, self._states.write(HOME, REST, stamp_ns=tick * TICK_NS))

    def command(self, torque=TORQUE):
        hand_in(self.node.inbox, topics.ADAPTER_COMMANDS, self._commands.write(torque))


@pytest.fixture
def bench(request):
    with ros(*request.param):
        yield Bench()


asking = pytest.mark.parametrize("bench", [()], indirect=True)
simple = pytest.mark.parametrize("bench", [("effort.ask_joints:=false",)], indirect=True)
in_lockstep = pytest.mark.parametrize("bench", [("effort.ask_joints:=false", "use_sim_time:=true")], indirect=True)


def effort_controller(bench, joints):
    """A node with the parameter of an effort controller of ros2_control."""
    node = rclpy.create_node("effort_controller", use_global_arguments=False)
    node.declare_parameter("joints", joints)
    bench.executor.add_node(node)
    return node


@asking
def test_commands_are_put_into_the_order_of_the_controller_that_takes_them(bench):
    bench.state()
    bench.command()
    assert bench.sent == [] and bench.node.refused == {"commands": 1}
    assert "joints of effort_controller is not known yet" in bench.node.diagnosis()[0]
    order = [2, 0, 1, 6, 5, 4, 3]
    keep = effort_controller(bench, [NAMES[index] for index in order])
    bench.until(lambda: not bench.node.diagnosis()[0], "the joints are known")
    bench.command()
    assert bench.sent == [TORQUE[order].tolist()]
    del keep


@asking
def test_joints_that_do_not_match_are_named_beside_the_arms_and_nothing_passes(bench):
    keep = effort_controller(bench, ["elbow", *NAMES[1:]])
    bench.until(lambda: "elbow" in bench.node.diagnosis()[0], "the joints are known")
    assert all(name in bench.node.diagnosis()[0] for name in NAMES)
    bench.state()
    bench.command()
    assert bench.sent == [] and bench.node.refused == {"commands": 1}
    del keep


@asking
def test_a_controller_in_another_namespace_is_named_with_the_setting(bench):
    keep = rclpy.create_node("effort_controller", namespace="left", use_global_arguments=False)
    bench.until(lambda: bench.node._target.look() or "there is" in bench.node.diagnosis()[0], "it is discovered")
    there = "there is /left/effort_controller: set the parameter effort.controller to it"
    assert there in bench.node.diagnosis()[0]
    keep.destroy_node()


@simple
def test_a_controller_that_counts_on_another_gravity_is_refused(bench):
    bench.state()
    for value, count in (("true", 1), ("false", 1), ("true", 2)):
        settings = to_status("controller", "", {"supervision.gravity_compensation": value})
        hand_in(bench.node.inbox, topics.SETTINGS, serialize_message(settings))
        bench.command()
        assert len(bench.sent) == count
    assert "gravity_compensation = False in the controller" in bench.node.boundary.last_refusals()[-1]


@simple
def test_settings_that_cannot_be_compared_are_refused_and_stop_nothing(bench, monkeypatch):
    """As the thresholds of another arm."""
    franka = FrankaTarget(bench.node, bench.node.arm, FrankaSettings(set_reflexes=False))
    monkeypatch.setattr(bench.node._target, "hear", franka.hear)
    bench.state()
    settings = to_status("observer", "", {"budget.torque_thresholds": "[1.0, 2.0]"})
    hand_in(bench.node.inbox, topics.SETTINGS, serialize_message(settings))
    bench.command()
    assert not bench.sent and not bench.node.stop_reason
    assert "the settings of observer cannot be compared: " in bench.node.boundary.last_refusals()[-1]


@simple
def test_a_second_commander_stops_it_until_it_has_gone(bench):
    bench.state()
    bench.command()
    controller = rclpy.create_node("controller", use_global_arguments=False)
    publishers = [bench.publish(topics.ADAPTER_COMMANDS, by) for by in (controller, bench.other)]
    bench.until(lambda: bench.node.rivals, "both are found")
    bench.node.inbox.run_tasks()
    assert bench.node.diagnosis()[0].startswith("2 publishers on /adapter/commands (/controller, /intruder)")
    bench.command()
    assert len(bench.sent) == 1
    bench.other.destroy_publisher(publishers.pop())
    bench.until(lambda: not bench.node.rivals, "the rival is gone")
    bench.state(2)
    bench.node.reset()
    bench.command()
    # A harmless torque for the state that came while it was stopped, and the command.
    assert len(bench.sent) == 3


@in_lockstep
def test_in_lockstep_silence_is_measured_by_the_states(bench):
    bench.node.trigger_configure()
    bench.state(1)
    bench.command(GRAVITY)
    for tick in range(2, 130):
        bench.state(tick)
    assert bench.node._guard.stop_reason.startswith("no command for")
    # One harmless torque for each state after the silence of 20 ms.
    assert len(bench.sent) == 1 + 129 - 21
    np.testing.assert_allclose(bench.sent[-1], GRAVITY, atol=1e-9)


@simple
def test_deactivated_it_leaves_an_arm_at_rest_under_harmless_torques(bench):
    bench.node.trigger_configure()
    bench.node.trigger_activate()
    bench.state()
    bench.command(GRAVITY)
    bench.node.trigger_deactivate()
    assert bench.node._guard.stop_reason == "the adapter is deactivated"
    np.testing.assert_allclose(bench.sent[-1], GRAVITY, atol=1e-9)


def asked_to_end(bench, seconds, tick=10):
    """Whether the node may end when it has been asked for some seconds, while joint states come."""
    may = [False]
    until = time.monotonic() + seconds
    while time.monotonic() < until and not may[-1]:
        if tick:
            bench.state(tick)
            tick += 1
        bench.node._look_for_silence()
        bench.node.inbox.run_tasks()
        may.append(bench.node.may_end(insists=False))
        time.sleep(0.02)
    return may[-1]


@simple
def test_without_a_command_it_ends_when_it_is_asked_to(bench):
    activate(bench.node)
    assert asked_to_end(bench, 0.5)


@simple
def test_an_arm_that_it_commands_is_held_until_the_user_insists(bench):
    activate(bench.node)
    bench.state()
    bench.command(GRAVITY)
    assert not asked_to_end(bench, 1.5)
    assert bench.node.stop_reason == "the adapter is asked to end"
    np.testing.assert_allclose(bench.sent[-1], GRAVITY, atol=1e-9)
    bench.command()
    assert bench.node.refused == {"commands": 1} and len(bench.sent) > 10
    with pytest.raises(InputError, match="asked to end"):
        bench.node.reset()
    assert bench.node.may_end(insists=True)


@simple
def test_it_ends_when_states_have_ceased_and_nobody_hears_the_torques(bench):
    activate(bench.node)
    bench.state()
    bench.command()
    keep = bench.other.create_subscription(
        topics.COMMANDS.type, topics.COMMANDS.name, print, qos_profile(topics.COMMANDS.qos)
    )
    bench.until(lambda: bench.node.count_subscribers(topics.COMMANDS.name), "the driver is discovered")
    assert not asked_to_end(bench, 1.5, tick=0)
    bench.other.destroy_subscription(keep)
    assert asked_to_end(bench, 5.0, tick=0)


def activate(node):
    node.trigger_configure()
    node.trigger_activate()
    node.running = True
