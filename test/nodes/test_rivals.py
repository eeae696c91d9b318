"""Nobody else may command the arm, or publish what it is commanded by."""

import time
from collections import Counter
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import UNWATCHED, hand_in, ros
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from contact_reach_ros.arm.joint_state import JointState as ArmState
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.errors import InputError, StopCode
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.graph import UNKNOWN_NODE, _has_strangers
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import ALONE
from contact_reach_ros.world.spheres import Spheres

REFERENCES = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)

_ATTEMPTS = 500


class Bench:
    """A controller whose loop and timers run when the test lets them, and another node beside it."""

    def __init__(self):
        self.node, self.other = ControllerNode(), rclpy.create_node("intruder")
        self.received = {topic.name: 0 for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS)}
        for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS):
            self.other.create_subscription(
                Float64MultiArray, topic.name, lambda _, name=topic.name: self._count(name), qos_profile(topic.qos)
            )
        self._states = self.other.create_publisher(
            topics.JOINT_STATES.type, topics.JOINT_STATES.name, qos_profile(topics.JOINT_STATES.qos)
        )
        self.node.boundary.protect(self.node)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._executor.add_node(self.other)
        self.supervisor = self.node._controller.supervisor

    def _count(self, name):
        self.received[name] += 1

    def until(self, condition, what):
        """Send joint states and let everything run until something has happened."""
        for _ in range(_ATTEMPTS):
            if condition():
                return
            message = JointState(
                name=list(iiwa14.ARM.joint_names), position=HOME.tolist(), velocity=np.zeros(7).tolist()
            )
            message.header.stamp = self.node.get_clock().now().to_msg()
            self._states.publish(message)
            self.node.inbox.wait(20_000_000)
            until = time.monotonic() + 0.02
            while time.monotonic() < until:
                self._executor.spin_once(0.005)
        pytest.fail(f"not within {_ATTEMPTS} attempts: {what}")

    def reset(self):
        """Answer of the service, whose callback is the executor's to call."""
        (service,) = (service for service in self.node.services if service.srv_name.endswith("/reset"))
        return service.callback(Trigger.Request(), Trigger.Response())


@contextmanager
def bench(*arguments, remap=()):
    args = [*UNWATCHED, *(part for argument in arguments for part in ("-p", argument))]
    args += [part for rule in remap for part in ("-r", rule)]
    with ros(*args):
        yield Bench()


def publisher_of(bench, topic):
    return bench.other.create_publisher(topic.type, topic.name, qos_profile(topic.qos))


@pytest.mark.parametrize("topic", ALONE, ids=lambda topic: topic.name)
def test_the_controller_stops_for_a_second_publisher_and_says_who(topic):
    with bench() as it:
        # One publisher of references is the planner; the bench publishes joint states.
        planner = publisher_of(it, topic) if topic in REFERENCES else None
        it.until(lambda: it.received[topics.COMMANDS.name] > 3, "commands")
        assert not it.supervisor.stop_reason
        rival = publisher_of(it, topic)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on /{topic.name} (")
        assert "/intruder" in it.supervisor.stop_reason
        refused = it.reset()
        assert not refused.success and "end the others first" in refused.message
        it.other.destroy_publisher(rival)
        it.until(lambda: not it.node._controller.not_yet, "the rival is gone")
        assert it.reset().success
        assert not it.supervisor.stop_reason
        del planner


@pytest.mark.parametrize("name", ["intruder", "controller"])
def test_the_controller_stops_for_a_stranger_or_a_second_node_of_a_name_in_safety_state(name):
    with bench() as it:
        others = [rclpy.create_node(name) for name in ("driver", "observer")]
        for other in others:
            other.create_publisher(DiagnosticStatus, topics.SAFETY_STATE.name, qos_profile(topics.SAFETY_STATE.qos))
        it.until(lambda: it.received[topics.COMMANDS.name] > 3, "commands")
        it.until(lambda: it.node.count_publishers(topics.SAFETY_STATE.name) == 3, "all are found")
        it.node.look_around()
        assert not it.node._controller.not_yet
        rival = it.other if name == "intruder" else rclpy.create_node(name)
        rival.create_publisher(DiagnosticStatus, topics.SAFETY_STATE.name, qos_profile(topics.SAFETY_STATE.qos))
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.code is StopCode.RIVAL
        names = ", ".join(sorted(["/driver", "/observer", "/controller", f"/{name}"]))
        expected = "expected one each of driver, controller, observer, adapter"
        assert str(it.supervisor.stop_reason) == f"4 publishers on /safety_state ({names}), {expected}"
        assert "end the others first" in it.reset().message


@pytest.mark.parametrize(
    ("names", "are_wrong"),
    [
        ([], False),
        (["driver", "observer"], False),
        (["driver", "driver"], True),
        (["driver", "somebody"], True),
        # Endpoints that are discovered before their nodes may be the driver's and the observer's.
        (["controller", UNKNOWN_NODE, UNKNOWN_NODE], False),
        (["controller", UNKNOWN_NODE, UNKNOWN_NODE, UNKNOWN_NODE], True),
        (["controller", "driver", "observer", UNKNOWN_NODE], True),
    ],
)
def test_who_may_report_what_stops_the_arm(names, are_wrong):
    assert _has_strangers(Counter(names), ["driver", "controller", "observer"]) is are_wrong


@pytest.mark.parametrize(
    ("remap", "resolved"),
    [("__ns:=/left", "/left/joint_states"), ("joint_states:=/arm/it", "/arm/it")],
    ids=["namespace", "remapped"],
)
def test_topics_are_looked_at_by_the_names_that_they_have_here(remap, resolved):
    with bench(remap=[remap]) as it:
        it.until(lambda: it.received[topics.COMMANDS.name] > 3, "commands")
        rival = publisher_of(it, topics.JOINT_STATES)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on {resolved} (")
        del rival


def test_the_observer_stops_for_a_second_publisher_of_joint_states_and_is_not_reset_beside_it():
    with ros():
        observer, other = ObserverNode(), rclpy.create_node("intruder")
        executor = SingleThreadedExecutor()
        executor.add_node(observer)
        publishers = [other.create_publisher(JointState, topics.JOINT_STATES.name, 1) for _ in range(2)]
        observer.trigger_configure()
        _spin_until(executor, lambda: observer.rivals)
        # Not active, it watches nothing.
        assert observer.diagnosis()[0].startswith("2 publishers on /joint_states (/intruder, /intruder), expected the")
        observer.inbox.run_tasks()
        assert not observer._observer.monitor.stop_reason
        observer.trigger_activate()
        observer.look_around()
        observer.inbox.run_tasks()
        assert observer._observer.monitor.stop_reason.code is StopCode.RIVAL
        with pytest.raises(InputError, match="end the others first"):
            observer._answer_reset()
        other.destroy_publisher(publishers.pop())
        _spin_until(executor, lambda: not observer.rivals)
        observer._answer_reset()
        assert not observer._observer.monitor.stop_reason


def test_the_planner_withdraws_its_goal_and_takes_none_beside_a_second_publisher():
    with ros():
        planner, other = PlannerNode(), rclpy.create_node("intruder")
        executor = SingleThreadedExecutor()
        executor.add_node(planner)
        planner._planner.see(Spheres.none())
        planner._planner.request(ArmState(0, HOME, np.zeros(7), None))
        goal = to_goal_pose([0.5, 0.1, 0.4], iiwa14.ARM.base_frame, Time())
        publishers = [other.create_publisher(JointState, topics.JOINT_STATES.name, 1)]
        planner._on_goal(goal)
        _spin_until(executor, lambda: planner.count_publishers(topics.JOINT_STATES.name))
        planner.look_around()
        planner.inbox.run_tasks()
        assert planner._planner.goal is not None
        publishers.append(other.create_publisher(JointState, topics.JOINT_STATES.name, 1))
        _spin_until(executor, lambda: planner.rivals)
        planner.inbox.run_tasks()
        assert planner._planner.goal is None
        assert planner.diagnosis()[0].startswith("2 publishers on /joint_states (/intruder, /intruder), expected the")
        hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal))
        assert planner._planner.goal is None and planner.refused == {"goals": 1}
        assert planner.boundary.last_refusals()[-1].endswith("no goal is taken; end the others")
        other.destroy_publisher(publishers.pop())
        _spin_until(executor, lambda: not planner.rivals)
        planner._on_goal(goal)
        assert planner._planner.goal is not None


def test_in_the_shadow_of_another_controller_nothing_is_commanded():
    with bench("supervision.shadow:=true") as it:
        rival = publisher_of(it, topics.COMMANDS)
        it.until(lambda: it.received[topics.SHADOW_COMMANDS.name] > 3, "torques on shadow/commands")
        assert it.received[topics.COMMANDS.name] == 0
        assert it.node.count_publishers(topics.COMMANDS.name) == 1
        assert not it.supervisor.stop_reason
        del rival


def test_the_driver_takes_no_command_from_two_and_says_who_they_are():
    with ros():
        driver, other = DriverNode(), rclpy.create_node("intruder")
        executor = SingleThreadedExecutor()
        executor.add_node(driver)
        executor.add_node(other)
        publishers = [other.create_publisher(Float64MultiArray, topics.COMMANDS.name, 1) for _ in range(2)]
        # As after the hand-over.
        drive = driver.robot.drive
        drive.is_open = True
        _spin_until(executor, lambda: drive.stop_reason)
        assert drive.stop_reason.startswith("2 publishers on /effort_controller/commands (/intruder, /intruder)")
        hand_in(driver.inbox, topics.COMMANDS, serialize_message(Float64MultiArray(data=[1.0] * 7)))
        assert driver.refused == {"commands": 1} and drive.rejected == 0
        other.destroy_publisher(publishers.pop())
        _spin_until(executor, lambda: not driver.rivals)
        hand_in(driver.inbox, topics.COMMANDS, serialize_message(Float64MultiArray(data=[1.0] * 7)))
        assert driver.refused == {"commands": 1}


def _spin_until(executor, condition):
    for _ in range(_ATTEMPTS):
        if condition():
            return
        executor.spin_once(0.05)
    pytest.fail(f"not within {_ATTEMPTS} turns")
