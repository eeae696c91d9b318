"""What a fault of a node's own program leads to, and what its lifecycle, its services and its parameters permit."""

import threading
from contextlib import contextmanager

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from stack_helpers import UNWATCHED, AtRest, Published, hand_in, ros
from std_msgs.msg import Int64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, StopCode, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.intake import COLUMNS, Taken
from contact_reach_ros.messages.serialized import read_command
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.boundary import INTERNAL


@contextmanager
def active(node_class):
    """An active node with its boundary, and a function that gives it joint states."""
    with ros(UNWATCHED):
        node = node_class()
        node.boundary.protect(node)
        node.trigger_configure()
        node.trigger_activate()
        yield node, AtRest(node).give


@pytest.fixture
def controller():
    with active(ControllerNode) as (node, give):
        node.look_around()
        node.commands = []
        node._write_commands = node.commands.append
        give(5)
        assert len(node.commands) == 5
        yield node, give


def change_state(node, **transition):
    (service,) = (service for service in node.services if service.srv_type is ChangeState)
    request = ChangeState.Request(transition=Transition(**transition))
    return service.callback(request, ChangeState.Response()).success


def test_a_fault_in_reading_references_stops_the_arm_compliantly(controller, monkeypatch):
    node, give = controller
    reported = []
    monkeypatch.setattr(node.boundary, "_report", reported.append)
    monkeypatch.setattr("contact_reach_ros.messages.plan_reader.read_postures", lambda *_: 1 / 0)
    for _ in range(3):
        hand_in(node.inbox, topics.REFERENCE_POSTURE, serialize_message(JointTrajectory()))
        give()
    assert node.refused == {INTERNAL: 3}
    # Its traceback once.
    (report,) = reported
    assert "ZeroDivisionError" in report and "references" in report
    assert node._controller.mode is Mode.STOPPED
    assert node._controller.stop_reason.code is StopCode.INTERNAL
    assert str(node._controller.stop_reason) == "internal error in handling references: ZeroDivisionError; see the log"
    # The compliant stop is commanded like any other.
    assert len(node.commands) == 8 and np.isfinite(read_command(node.commands[-1])).all()


def test_a_fault_in_the_observer_stops_the_arm(monkeypatch):
    with active(ObserverNode) as (node, give):
        node._safety = Published()
        give(2)
        with monkeypatch.context() as patch:
            patch.setattr(node._observer.momentum, "update", lambda *_: 1 / 0)
            give()
        give()
        message = node._safety.messages[-1]
        assert message.level == DiagnosticStatus.ERROR
        assert message.message.startswith("internal error in handling joint states")
        assert {entry.key: entry.value for entry in message.values}["stop code"] == StopCode.INTERNAL.value


def test_a_transition_that_fails_says_why_and_the_node_is_not_active(controller, monkeypatch):
    node, _ = controller
    assert change_state(node, label="deactivate") and not node.running

    def fail(*_):
        raise InputError("no such arm")

    monkeypatch.setattr(node, "look_around", fail)
    assert not change_state(node, id=Transition.TRANSITION_ACTIVATE)
    assert node.refused == {"transitions": 1} and not node.running
    monkeypatch.undo()
    assert change_state(node, id=Transition.TRANSITION_ACTIVATE) and node.running
    assert change_state(node, id=Transition.TRANSITION_ACTIVE_SHUTDOWN) and not node.running


def test_a_message_that_would_take_long_to_read_is_refused_unread(controller):
    node, give = controller
    hand_in(node.inbox, topics.REFERENCE_POSTURE, serialize_message(JointTrajectory(joint_names=["a" * 100_000])))
    assert node.refused == {"references": 1}
    (line,) = node.boundary.last_refusals()
    assert "bytes; expected at most 65536" in line
    give()
    assert not node._controller.stop_reason


@pytest.mark.parametrize("node_class", [AdapterNode, ControllerNode, DriverNode, ObserverNode, PlannerNode])
def test_a_node_keeps_the_parameters_that_it_was_started_with(node_class):
    values = {"tool.mass": 1.0, "use_sim_time": True, "cpus": "all", "state_rate": 500.0}
    with ros():
        node = node_class()
        results = node.set_parameters([Parameter(name, value=value) for name, value in values.items()])
        assert all(not result.successful and "read-only" in result.reason for result in results)
        assert all(node.get_parameter(name).value != value for name, value in values.items())


def test_the_speed_of_a_planner_may_be_changed_within_its_bounds():
    with ros():
        node = PlannerNode()
        wrong, right = node.set_parameters([Parameter("speed_scale", value=value) for value in (2, 0.5)])
    assert not wrong.successful and "speed_scale = 2: expected a number in [0.01, 1]" in wrong.reason
    assert right.successful and node.reported_settings()["speed_scale"] == node._planner.speed_scale == 0.5


def test_a_reset_before_any_joint_state_is_refused_with_the_reason():
    with ros():
        node = ControllerNode()
        node.boundary.protect(node)
        threading.Timer(0.1, node.inbox.run_tasks).start()
        (service,) = (service for service in node.services if service.srv_name.endswith("/reset"))
        answer = service.callback(Trigger.Request(), Trigger.Response())
    assert (answer.success, answer.message) == (False, "the controller has not seen a joint state yet")


@pytest.mark.parametrize("node_class", [ControllerNode, ObserverNode])
@pytest.mark.parametrize("running", [True, False])
def test_a_requested_stop_is_in_the_bag_at_once_with_all_that_came_before_or_waits_while_inactive(node_class, running):
    """A bag may end right after a stop: what led to it has been published by then."""
    with ros():
        node, rows = node_class(), []

        def publish(data):
            numbers = list(deserialize_message(data, Int64MultiArray).data)[1:]
            rows.extend(numbers[:: len(COLUMNS)])

        node.inbox.intake._publish = publish
        node.running = running
        node.inbox.intake.add(Taken.JOINT_STATES, 1, 2)
        assert rows == []
        node.stop_for(requested("stop service called"))
        assert rows == ([Taken.JOINT_STATES, Taken.STOP] if running else [])
        node.inbox.intake.flush()
        assert rows == [Taken.JOINT_STATES, Taken.STOP]
