"""The planner reports whether a controller hears it: what it plans before that is lost."""

from collections.abc import Iterator

import pytest
import rclpy
from arm_simulation import HOME, REST
from rclpy.node import Node
from stack_helpers import ros, wait_for

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.world.spheres import Spheres

HALVES = (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)


@pytest.fixture
def planner() -> Iterator[PlannerNode]:
    with ros():
        node = PlannerNode()
        node._planner.state = JointState(0, HOME, REST, None)
        node._planner.see(Spheres.none())
        yield node


def make(name: str, heard: tuple[Topic, ...], published: tuple[Topic, ...] = ()) -> Node:
    """A node with these subscriptions and publishers."""
    node = rclpy.create_node(name)
    for topic in heard:
        node.create_subscription(topic.type, topic.name, lambda _: None, qos_profile(topic.qos))
    for topic in published:
        node.create_publisher(topic.type, topic.name, qos_profile(topic.qos))
    return node


def known(planner: PlannerNode) -> set[str]:
    """Nodes that the planner knows to hear a half of its plans, once it knows who commands the arm."""
    commanding = planner.get_publishers_info_by_topic(topics.COMMANDS.name)
    hearing = planner.get_subscriptions_info_by_topic(topics.REFERENCE_POSE.name)
    return {info.node_name for info in hearing} if [info.node_name for info in commanding] == ["half"] else set()


def test_only_a_node_that_commands_the_arm_and_hears_both_halves_of_a_plan_counts(planner: PlannerNode) -> None:
    recorder = make("recorder", (*HALVES, topics.COMMANDS))
    half = make("half", HALVES[:1], (topics.COMMANDS,))
    wait_for(lambda: known(planner) == {"recorder", "half"}, 10, "both are found, by name")
    summary, values = planner.diagnosis()
    assert (summary, values["heard by"]) == (topics.WAITING_FOR_CONTROLLER, "")
    controller = make("some_controller", HALVES, (topics.COMMANDS,))
    wait_for(lambda: planner.diagnosis()[1]["heard by"] == "/some_controller", 10, "the controller is found")
    assert planner.diagnosis()[0] == "waiting for a goal"
    controller.destroy_node()
    wait_for(lambda: planner.diagnosis()[0] == topics.WAITING_FOR_CONTROLLER, 10, "the controller is gone")
    shadow = make("shadow", HALVES, (topics.SHADOW_COMMANDS,))
    wait_for(lambda: planner.diagnosis()[1]["heard by"] == "/shadow", 10, "one that only computes counts, too")
    for node in (recorder, half, shadow):
        node.destroy_node()
