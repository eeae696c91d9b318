"""Nobody else may command the arm, or publish what it is commanded by."""

from collections import Counter
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME
from builtin_interfaces.msg import Time
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


class Beside:
    """A node whose timers run when the test lets them, and an intruder."""

    def __init__(self, node_class):
        self.node, self.intruder = node_class(), rclpy.create_node("intruder")
        self.node.boundary.protect(self.node)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.intruder)

    def publish(self, topic, by=None):
        return (by or self.intruder).create_publisher(topic.type, topic.name, qos_profile(topic.qos))

    def until(self, condition, what, meanwhile=lambda: None):
        for _ in range(500):
            if condition():
                return
            meanwhile()
            self.executor.spin_once(0.05)
            self.node.inbox.run_tasks()
        pytest.fail(f"not within 500 turns: {what}")


@contextmanager
def beside(node_class, *arguments):
    with ros(*arguments):
        yield Beside(node_class)


class Moving(Beside):
    """A controller that answers joint states with commands."""

    def __init__(self):
        super().__init__(ControllerNode)
        self.received = {topic.name: 0 for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS)}
        for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS):
            count = lambda _, name=topic.name: self.received.update({name: self.received[name] + 1})  # noqa: E731
            self.intruder.create_subscription(topic.type, topic.name, count, qos_profile(topic.qos))
        self._states = self.publish(topics.JOINT_STATES)
        self.supervisor = self.node._controller.supervisor

    def until(self, condition, what):
        super().until(condition, what, self._show)

    def _show(self):
        names, still = list(iiwa14.ARM.joint_names), np.zeros(7).tolist()
        state = JointState(name=names, position=HOME.tolist(), velocity=still)
        state.header.stamp = self.node.get_clock().now().to_msg()
        self._states.publish(state)
        self.node.inbox.wait(20_000_000)

    def reset(self):
        """Answer of the service, whose callback is the executor's to call."""
        (service,) = (service for service in self.node.services if service.srv_name.endswith("/reset"))
        return service.callback(Trigger.Request(), Trigger.Response())


@contextmanager
def moving(*arguments):
    with ros(*UNWATCHED, *arguments):
        it = Moving()
        yield it


def commanding(it):
    it.until(lambda: it.received[topics.COMMANDS.name] > 3, "commands")
    assert not it.supervisor.stop_reason


@pytest.mark.parametrize("topic", ALONE, ids=lambda topic: topic.name)
def test_the_controller_stops_for_a_second_publisher_and_says_who(topic):
    with moving() as it:
        # One publisher of references is the planner; the bench publishes joint states.
        planner = it.publish(topic) if topic in REFERENCES else None
        commanding(it)
        rival = it.publish(topic)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on /{topic.name} (")
        assert "/intruder" in it.supervisor.stop_reason
        refused = it.reset()
        assert not refused.success and "end the others first" in refused.message
        it.intruder.destroy_publisher(rival)
        it.until(lambda: not it.node._controller.not_yet, "the rival is gone")
        assert it.reset().success and not it.supervisor.stop_reason
        del planner


@pytest.mark.parametrize("name", ["intruder", "controller"])
def test_the_controller_stops_for_a_stranger_or_a_second_node_of_a_name_in_safety_state(name):
    with moving() as it:
        others = [rclpy.create_node(other) for other in ("driver", "observer")]
        published = [it.publish(topics.SAFETY_STATE, other) for other in others]
        commanding(it)
        it.until(lambda: it.node.count_publishers(topics.SAFETY_STATE.name) == 3, "all are found")
        it.node.look_around()
        assert not it.node._controller.not_yet
        rival = it.intruder if name == "intruder" else rclpy.create_node(name)
        published.append(it.publish(topics.SAFETY_STATE, rival))
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.code is StopCode.RIVAL
        names = ", ".join(sorted(["/driver", "/observer", "/controller", f"/{name}"]))
        assert it.supervisor.stop_reason.startswith(f"4 publishers on /safety_state ({names}), expected one each of")
        assert "end the others first" in it.reset().message


@pytest.mark.parametrize(
    ("names", "are_wrong"),
    [
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
    ("rule", "resolved"),
    [("__ns:=/left", "/left/joint_states"), ("joint_states:=/arm/it", "/arm/it")],
    ids=["namespace", "remapped"],
)
def test_topics_are_looked_at_by_the_names_that_they_have_here(rule, resolved):
    with moving("-r", rule) as it:
        commanding(it)
        rival = it.publish(topics.JOINT_STATES)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on {resolved} (")
        del rival


def test_in_the_shadow_of_another_controller_nothing_is_commanded():
    with moving("-p", "supervision.shadow:=true") as it:
        rival = it.publish(topics.COMMANDS)
        it.until(lambda: it.received[topics.SHADOW_COMMANDS.name] > 3, "torques on shadow/commands")
        assert it.received[topics.COMMANDS.name] == 0
        assert it.node.count_publishers(topics.COMMANDS.name) == 1
        assert not it.supervisor.stop_reason
        del rival


TWO_STATES = "2 publishers on /joint_states (/intruder, /intruder), expected the"


def test_the_observer_stops_for_a_second_publisher_of_joint_states_and_is_not_reset_beside_it():
    with beside(ObserverNode) as it:
        observer, publishers = it.node, [it.publish(topics.JOINT_STATES) for _ in range(2)]
        observer.trigger_configure()
        it.until(lambda: observer.rivals, "both are found")
        # Not active, it watches nothing.
        assert observer.diagnosis()[0].startswith(TWO_STATES) and not observer._observer.monitor.stop_reason
        observer.trigger_activate()
        observer.look_around()
        observer.inbox.run_tasks()
        assert observer._observer.monitor.stop_reason.code is StopCode.RIVAL
        with pytest.raises(InputError, match="end the others first"):
            observer._answer_reset()
        it.intruder.destroy_publisher(publishers.pop())
        it.until(lambda: not observer.rivals, "the rival is gone")
        observer._answer_reset()
        assert not observer._observer.monitor.stop_reason


def test_the_planner_withdraws_its_goal_and_takes_none_beside_a_second_publisher():
    with beside(PlannerNode) as it:
        planner, goal = it.node, to_goal_pose([0.5, 0.1, 0.4], iiwa14.ARM.base_frame, Time())
        planner._planner.see(Spheres.none())
        planner._planner.request(ArmState(0, HOME, np.zeros(7), None))
        publishers = [it.publish(topics.JOINT_STATES)]
        planner._on_goal(goal)
        it.until(lambda: planner.count_publishers(topics.JOINT_STATES.name), "the first one is found")
        planner.look_around()
        planner.inbox.run_tasks()
        assert planner._planner.goal is not None
        publishers.append(it.publish(topics.JOINT_STATES))
        it.until(lambda: planner.rivals and planner._planner.goal is None, "the goal is withdrawn")
        assert planner.diagnosis()[0].startswith(TWO_STATES)
        hand_in(planner.inbox, topics.GOAL_POSE, serialize_message(goal))
        assert planner._planner.goal is None and planner.refused == {"goals": 1}
        assert planner.boundary.last_refusals()[-1].endswith("no goal is taken; end the others")
        it.intruder.destroy_publisher(publishers.pop())
        it.until(lambda: not planner.rivals, "the rival is gone")
        planner._on_goal(goal)
        assert planner._planner.goal is not None


def test_the_driver_takes_no_command_from_two_and_says_who_they_are():
    with beside(DriverNode) as it:
        driver, publishers = it.node, [it.publish(topics.COMMANDS) for _ in range(2)]
        # As after the hand-over.
        drive = driver.robot.drive
        drive.is_open = True
        it.until(lambda: drive.stop_reason, "the stop")
        assert drive.stop_reason.startswith("2 publishers on /effort_controller/commands (/intruder, /intruder)")
        command = serialize_message(Float64MultiArray(data=[1.0] * 7))
        hand_in(driver.inbox, topics.COMMANDS, command)
        assert driver.refused == {"commands": 1} and drive.rejected == 0
        it.intruder.destroy_publisher(publishers.pop())
        it.until(lambda: not driver.rivals, "the rival is gone")
        hand_in(driver.inbox, topics.COMMANDS, command)
        assert driver.refused == {"commands": 1}
