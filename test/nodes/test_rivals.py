"""Nobody else may command the arm or publish references."""

import time
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from arm_simulation import HOME
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from stack_helpers import environment
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.robot import iiwa14

_ATTEMPTS = 200


class Bench:
    """A controller whose loop and timers run when told to, and another node beside it."""

    def __init__(self):
        self.node, self.other = ControllerNode(), rclpy.create_node("intruder")
        self.received = {topic.name: 0 for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS)}
        for topic in (topics.COMMANDS, topics.SHADOW_COMMANDS):
            self.other.create_subscription(
                Float64MultiArray, topic.name, lambda _, name=topic.name: self._count(name), topic.qos
            )
        self._states = self.other.create_publisher(
            topics.JOINT_STATES.type, topics.JOINT_STATES.name, topics.JOINT_STATES.qos
        )
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
            message = JointState(name=list(iiwa14.JOINT_NAMES), position=HOME.tolist(), velocity=np.zeros(7).tolist())
            message.header.stamp = self.node.get_clock().now().to_msg()
            self._states.publish(message)
            self.node.inbox.wait(20_000_000)
            until = time.monotonic() + 0.02
            while time.monotonic() < until:
                self._executor.spin_once(0.005)
        pytest.fail(f"not within {_ATTEMPTS} attempts: {what}")

    def reset(self):
        return self.node._on_reset(Trigger.Request(), Trigger.Response())


@contextmanager
def bench(*arguments):
    args = ["--ros-args", *(part for argument in arguments for part in ("-p", argument))]
    rclpy.init(args=args, domain_id=int(environment()["ROS_DOMAIN_ID"]))
    try:
        yield Bench()
    finally:
        rclpy.shutdown()


def publisher_of(bench, topic):
    return bench.other.create_publisher(topic.type, topic.name, topic.qos)


@pytest.mark.parametrize("topic", [topics.COMMANDS, topics.REFERENCE_POSE, topics.REFERENCE_POSTURE])
def test_the_controller_stops_for_a_second_publisher_and_says_who(topic):
    with bench() as it:
        # One publisher of references is the planner.
        planner = None if topic is topics.COMMANDS else publisher_of(it, topic)
        it.until(lambda: it.received[topics.COMMANDS.name] > 3, "commands")
        assert not it.supervisor.stop_reason
        rival = publisher_of(it, topic)
        it.until(lambda: it.supervisor.stop_reason, "the stop")
        assert it.supervisor.stop_reason.startswith(f"2 publishers on {topic.name} (")
        assert "/intruder" in it.supervisor.stop_reason
        refused = it.reset()
        assert not refused.success and "end the others first" in refused.message
        it.other.destroy_publisher(rival)
        it.until(lambda: not it.node._rivalry, "the rival is gone")
        assert it.reset().success
        assert not it.supervisor.stop_reason
        del planner


def test_the_controller_does_not_start_beside_another_one():
    with bench() as it:
        rival = publisher_of(it, topics.COMMANDS)
        it.until(lambda: it.node.refused.get("joint states", 0) > 3, "refusals")
        assert it.received[topics.COMMANDS.name] == 0
        it.until(lambda: "2 publishers on effort_controller/commands" in it.node.diagnosis()[0], "the reason")
        it.other.destroy_publisher(rival)
        it.until(lambda: it.received[topics.COMMANDS.name] > 0, "commands")


def test_in_the_shadow_of_another_controller_nothing_is_commanded():
    with bench("supervision.shadow:=true") as it:
        rival = publisher_of(it, topics.COMMANDS)
        it.until(lambda: it.received[topics.SHADOW_COMMANDS.name] > 3, "torques on shadow/commands")
        assert it.received[topics.COMMANDS.name] == 0
        assert it.node.count_publishers(topics.COMMANDS.name) == 1
        assert not it.supervisor.stop_reason
        del rival


def test_the_driver_takes_no_command_from_two_and_says_who_they_are():
    rclpy.init(domain_id=int(environment()["ROS_DOMAIN_ID"]))
    try:
        driver, other = DriverNode(), rclpy.create_node("intruder")
        executor = SingleThreadedExecutor()
        executor.add_node(driver)
        executor.add_node(other)
        publishers = [other.create_publisher(Float64MultiArray, topics.COMMANDS.name, 1) for _ in range(2)]
        # As after the hand-over.
        driver._drive._opened = True
        _spin_until(executor, lambda: driver._drive.stop_reason)
        assert driver._drive.stop_reason.startswith("2 publishers on effort_controller/commands (/intruder, /intruder)")
        driver._on_command(serialize_message(Float64MultiArray(data=[1.0] * 7)))
        assert driver.refused == {"commands": 1} and driver._drive.rejected == 0
        other.destroy_publisher(publishers.pop())
        _spin_until(executor, lambda: not driver._rivalry)
        driver._on_command(serialize_message(Float64MultiArray(data=[1.0] * 7)))
        assert driver.refused == {"commands": 1}
    finally:
        rclpy.shutdown()


def _spin_until(executor, condition):
    for _ in range(_ATTEMPTS):
        if condition():
            return
        executor.spin_once(0.05)
    pytest.fail(f"not within {_ATTEMPTS} turns")
