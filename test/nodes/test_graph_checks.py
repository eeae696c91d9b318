"""Graphs of running stacks, good and bad; nothing has to run for them."""

import dataclasses

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy

from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.nodes import graph_checks, topics
from contact_reach_ros.nodes.graph_checks import Endpoint, Graph, type_name
from contact_reach_ros.nodes.interfaces import ALONE, MANAGED


def endpoints(wanted, act):
    """The stack's own publishers or subscriptions of a topic, as the nodes make them."""
    nodes = [name for name, interface in MANAGED.items() if wanted.name in getattr(interface, act)]
    return [Endpoint(f"/{name}", type_name(wanted), wanted.qos) for name in nodes]


GOOD = Graph(
    nodes=[f"/{name}" for name in MANAGED],
    publishers={wanted.name: endpoints(wanted, "publishes") for wanted in topics.ALL},
    subscriptions={wanted.name: endpoints(wanted, "subscribes") for wanted in topics.ALL},
    states=dict.fromkeys(MANAGED, "active"),
    simulated_time=dict.fromkeys(MANAGED, True),
    safety=[("controller", "holding", False), ("observer", "monitoring", False)],
)

WHOLE = (graph_checks.nodes, graph_checks.lifecycle, graph_checks.time_source, graph_checks.safety_state)


def changed(**changes):
    return dataclasses.replace(GOOD, **changes)


def without(topic_name):
    return changed(publishers={**GOOD.publishers, topic_name: []})


def with_publisher(wanted, *more):
    return changed(publishers={**GOOD.publishers, wanted.name: [*GOOD.publishers[wanted.name], *more]})


def test_a_good_graph_passes():
    findings = [check(GOOD) for check in WHOLE] + [graph_checks.topic(GOOD, wanted) for wanted in topics.ALL]
    assert [finding for finding in findings if finding.verdict is not Verdict.PASS] == []


@pytest.mark.parametrize("check", WHOLE)
def test_an_empty_graph_breaks_nothing(check):
    assert check(Graph()).verdict in (Verdict.PASS, Verdict.WARN)
    assert not Graph().running


def test_two_nodes_of_one_name():
    finding = graph_checks.nodes(changed(nodes=[*GOOD.nodes, "/controller"]))
    assert finding.verdict is Verdict.FAIL and "/controller" in finding.found and "ROS_DOMAIN_ID" in finding.fix


def test_a_missing_node_is_named_with_its_command():
    finding = graph_checks.nodes(changed(nodes=["/controller", "/planner", "/my_arm"]))
    assert finding.verdict is Verdict.FAIL and "not running: observer" in finding.found
    assert "ros2 run contact_reach_ros observer" in finding.fix


@pytest.mark.parametrize(
    ("state", "fix"), [("inactive", "/planner activate"), ("unconfigured", "/planner configure"), ("", "look into")]
)
def test_a_node_that_is_not_active(state, fix):
    finding = graph_checks.lifecycle(changed(states={**GOOD.states, "planner": state}))
    assert finding.verdict is Verdict.FAIL and "planner" in finding.found and fix in finding.fix


def test_simulated_time_needs_a_clock():
    finding = graph_checks.time_source(without("clock"))
    assert finding.verdict is Verdict.FAIL and "nobody publishes /clock" in finding.found


def test_all_nodes_have_one_time():
    mixed = changed(simulated_time={**GOOD.simulated_time, "observer": False})
    finding = graph_checks.time_source(mixed)
    assert finding.verdict is Verdict.FAIL and "observer" in finding.found and "use_sim_time" in finding.fix
    # The driver makes the clock and need not follow it.
    assert graph_checks.time_source(changed(simulated_time={"driver": False})).verdict is Verdict.PASS


def test_a_latched_stop_fails_with_the_call_that_releases_it():
    stopped = changed(safety=[("observer", "external torque on A2", True), ("controller", "holding", False)])
    finding = graph_checks.safety_state(stopped)
    assert finding.verdict is Verdict.FAIL and "external torque on A2" in finding.found
    assert "/observer/reset" in finding.fix and "/controller/reset" not in finding.fix


@pytest.mark.parametrize("wanted", ALONE, ids=lambda topic: topic.name)
def test_topics_that_must_have_one_publisher(wanted):
    finding = graph_checks.topic(with_publisher(wanted, Endpoint("/stranger", type_name(wanted), wanted.qos)), wanted)
    assert finding.verdict is Verdict.FAIL and "end /stranger" in finding.fix
    assert len(finding.values["publishers"]) == 2
    finding = graph_checks.topic(without(wanted.name), wanted)
    assert finding.verdict is Verdict.FAIL and "start" in finding.fix


def test_a_second_publisher_elsewhere_is_welcome():
    goal = Endpoint("/viewer", type_name(topics.GOAL_POSE), topics.GOAL_POSE.qos)
    assert graph_checks.topic(with_publisher(topics.GOAL_POSE, goal, goal), topics.GOAL_POSE).verdict is Verdict.PASS


def test_another_type_is_named():
    stranger = Endpoint("/viewer", "geometry_msgs/msg/Pose", topics.GOAL_POSE.qos)
    finding = graph_checks.topic(with_publisher(topics.GOAL_POSE, stranger), topics.GOAL_POSE)
    assert finding.verdict is Verdict.FAIL and "geometry_msgs/msg/PoseStamped" in finding.fix
    assert "viewer" in finding.found and "geometry_msgs/msg/Pose" in finding.found


def test_quality_of_service_that_does_not_match():
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    goal = Endpoint("/viewer", type_name(topics.GOAL_POSE), best_effort)
    finding = graph_checks.topic(with_publisher(topics.GOAL_POSE, goal), topics.GOAL_POSE)
    assert finding.verdict is Verdict.FAIL and "/planner gets nothing from /viewer" in finding.found
    assert "reliable" in finding.fix
    finding = graph_checks.topic(
        with_publisher(topics.OBSTACLES, Endpoint("/vision", type_name(topics.OBSTACLES), topics.STREAM)),
        topics.OBSTACLES,
    )
    assert finding.verdict is Verdict.FAIL and "transient local" in finding.fix
