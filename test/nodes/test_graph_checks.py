"""Graphs of running stacks, good and bad; nothing has to run for them."""

import dataclasses

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy

from contact_reach_ros.doctor import stack
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.doctor.stack import Endpoint, Graph
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import ADAPTER, ALONE, MANAGED

STACK = [name for name in MANAGED if name != ADAPTER]
"""The nodes of a stack whose driver watches the commands itself."""


def endpoints(wanted, act):
    """The stack's own publishers or subscriptions of a topic, as the nodes make them."""
    nodes = [name for name in STACK if wanted.name in getattr(MANAGED[name], act)]
    return [Endpoint(f"/{name}", wanted.type_name, qos_profile(wanted.qos)) for name in nodes]


GOOD = Graph(
    nodes=[f"/{name}" for name in STACK],
    publishers={wanted.name: endpoints(wanted, "publishes") for wanted in topics.ALL},
    subscriptions={wanted.name: endpoints(wanted, "subscribes") for wanted in topics.ALL},
    states=dict.fromkeys(STACK, "active"),
    safety=[("controller", "holding", False), ("observer", "monitoring", False)],
    settings={name: {"impedance.task_stiffness": 880.0, "state_rate": 500.0} for name in ("controller", "planner")},
)

WHOLE = (stack.nodes, stack.safety_state)


def changed(**changes):
    return dataclasses.replace(GOOD, **changes)


def without(topic_name):
    return changed(publishers={**GOOD.publishers, topic_name: []})


def with_publisher(wanted, *more):
    return changed(publishers={**GOOD.publishers, wanted.name: [*GOOD.publishers[wanted.name], *more]})


def test_a_good_graph_passes():
    findings = [check(GOOD) for check in WHOLE] + [stack.topic(GOOD, wanted) for wanted in topics.ALL]
    assert [finding for finding in findings if finding.verdict is not Verdict.PASS] == []


def test_two_nodes_of_one_name():
    finding = stack.nodes(changed(nodes=[*GOOD.nodes, "/controller"]))
    assert finding.verdict is Verdict.FAIL and "/controller" in finding.found and "ROS_DOMAIN_ID" in finding.fix


def test_a_missing_node_is_named_with_its_command():
    states = {"controller": "active", "planner": "active"}
    finding = stack.nodes(changed(nodes=["/controller", "/planner", "/my_arm"], states=states))
    assert finding.verdict is Verdict.FAIL and "observer is missing" in finding.found
    assert "ros2 run contact_reach_ros observer" in finding.fix


@pytest.mark.parametrize(
    ("state", "fix"), [("inactive", "/planner activate"), ("unconfigured", "/planner configure"), ("", "look into")]
)
def test_a_node_that_is_not_active(state, fix):
    finding = stack.nodes(changed(states={**GOOD.states, "planner": state}))
    assert finding.verdict is Verdict.FAIL and "planner" in finding.found and fix in finding.fix


def test_a_latched_stop_fails_with_the_call_that_releases_it():
    unwatched = stack.safety_state(changed(requires_observer=False))
    assert unwatched.verdict is Verdict.WARN and "may move unwatched" in unwatched.found
    stopped = changed(safety=[("observer", "external torque on A2", True), ("controller", "holding", False)])
    finding = stack.safety_state(stopped)
    assert finding.verdict is Verdict.FAIL and "external torque on A2" in finding.found
    assert "/observer/reset" in finding.fix and "/controller/reset" not in finding.fix


@pytest.mark.parametrize("wanted", ALONE, ids=lambda topic: topic.name)
def test_topics_that_must_have_one_publisher(wanted):
    finding = stack.topic(
        with_publisher(wanted, Endpoint("/stranger", wanted.type_name, qos_profile(wanted.qos))), wanted
    )
    assert finding.verdict is Verdict.FAIL and "end /stranger" in finding.fix
    assert "2 publishers" in finding.found
    finding = stack.topic(without(wanted.name), wanted)
    assert finding.verdict is Verdict.FAIL and "start" in finding.fix


def test_another_type_is_named():
    stranger = Endpoint("/viewer", "geometry_msgs/msg/Pose", qos_profile(topics.GOAL_POSE.qos))
    finding = stack.topic(with_publisher(topics.GOAL_POSE, stranger), topics.GOAL_POSE)
    assert finding.verdict is Verdict.FAIL and "geometry_msgs/msg/PoseStamped" in finding.fix
    assert "viewer" in finding.found and "geometry_msgs/msg/Pose" in finding.found


def test_quality_of_service_that_does_not_match():
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    goal = Endpoint("/viewer", topics.GOAL_POSE.type_name, best_effort)
    finding = stack.topic(with_publisher(topics.GOAL_POSE, goal), topics.GOAL_POSE)
    assert finding.verdict is Verdict.FAIL and "/planner gets nothing from /viewer" in finding.found
    assert "reliable" in finding.fix
    finding = stack.topic(
        with_publisher(topics.OBSTACLES, Endpoint("/vision", topics.OBSTACLES.type_name, qos_profile(topics.STREAM))),
        topics.OBSTACLES,
    )
    assert finding.verdict is Verdict.FAIL and "transient local" in finding.fix
