"""Graphs of running stacks, good and bad; nothing has to run for them."""

import dataclasses

import pytest
from interfaces import INTERFACES
from rclpy.qos import QoSProfile, ReliabilityPolicy

from contact_reach_ros.doctor import stack
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.doctor.stack import Endpoint, Graph
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import ADAPTER, ALONE, MANAGED

STACK = [name for name in MANAGED if name != ADAPTER]
"""The nodes of a stack whose driver watches the commands itself."""


def endpoints(act):
    """The stack's own publishers or subscriptions by topic, as the nodes make them."""
    found = {}
    for topic in topics.ALL:
        nodes = [name for name in STACK if topic.name in getattr(INTERFACES[name], act)]
        is_double = topic.from_anybody and act == "subscribes"
        profiles = [topic.qos, topic.qos._replace(latched=False)] if is_double else [topic.qos]
        found[topic.name] = [
            Endpoint(f"/{name}", topic.type_name, qos_profile(qos)) for name in nodes for qos in profiles
        ]
    return found


GOOD = Graph(
    nodes=[f"/{name}" for name in STACK],
    publishers=endpoints("publishes"),
    subscriptions=endpoints("subscribes"),
    states=dict.fromkeys(STACK, "active"),
    safety=[("controller", "holding", False), ("observer", "monitoring", False)],
)


def changed(**changes):
    return dataclasses.replace(GOOD, **changes)


def with_publishers(topic, *publishers):
    return changed(publishers={**GOOD.publishers, topic.name: list(publishers)})


def with_another(topic, **changes):
    """Beside the stack's own publisher; `changes` of what it should be."""
    profile = {"type_name": topic.type_name, "qos": qos_profile(topic.qos), **changes}
    return with_publishers(topic, *GOOD.publishers[topic.name], Endpoint("/stranger", *profile.values()))


def test_a_good_graph_passes():
    findings = [stack.nodes(GOOD), stack.safety_state(GOOD), *(stack.topic(GOOD, topic) for topic in topics.ALL)]
    assert [finding for finding in findings if finding.verdict is not Verdict.PASS] == []


@pytest.mark.parametrize(
    ("changes", "found", "fix"),
    [
        ({"nodes": [*GOOD.nodes, "/controller"]}, "/controller", "ROS_DOMAIN_ID"),
        ({"nodes": ["/my_arm"], "states": {}}, "observer is missing", "ros2 run contact_reach_ros observer"),
        ({"states": {**GOOD.states, "planner": "inactive"}}, "planner", "/planner activate"),
        ({"states": {**GOOD.states, "planner": "unconfigured"}}, "planner", "/planner configure"),
        ({"states": {**GOOD.states, "planner": ""}}, "planner", "look into"),
    ],
)
def test_nodes_that_are_missing_double_or_inactive_are_named_with_what_to_do(changes, found, fix):
    finding = stack.nodes(changed(**changes))
    assert finding.verdict is Verdict.FAIL and found in finding.found and fix in finding.fix


def test_where_nothing_runs_it_says_what_to_start():
    finding = stack.nodes(Graph(nodes=["/my_arm"]))
    assert finding.verdict is Verdict.WARN and "no stack is running" in finding.found
    assert "contact-reach up" in finding.fix


def test_a_latched_stop_fails_with_the_call_that_releases_it():
    unwatched = stack.safety_state(changed(settings={"controller": {"supervision.require_observer": False}}))
    assert unwatched.verdict is Verdict.WARN and "may move unwatched" in unwatched.found
    stopped = changed(safety=[("observer", "external torque on A2", True), ("controller", "holding", False)])
    finding = stack.safety_state(stopped)
    assert finding.verdict is Verdict.FAIL and "external torque on A2" in finding.found
    assert "/observer/reset" in finding.fix and "/controller/reset" not in finding.fix


def test_remedies_name_the_namespace_of_the_stack():
    names = [f"/left/{name}" for name in STACK]
    left = changed(namespace="/left", nodes=names, states={**GOOD.states, "planner": "inactive"})
    assert left.running and not changed(namespace="/left", publishers={}).running
    assert stack.nodes(left).fix == "ros2 lifecycle set /left/planner activate"
    fix = stack.safety_state(dataclasses.replace(left, safety=[("observer", "external torque", True)])).fix
    assert "contact-reach reset --namespace /left" in fix and "/left/observer/reset" in fix


@pytest.mark.parametrize(
    ("changes", "verdict", "found", "fix"),
    [
        ({"settings": {"driver": {"watchdog.enabled": True}}}, Verdict.PASS, "brakes the arm", ""),
        (
            {"settings": {"driver": {"watchdog.enabled": False}}},
            Verdict.WARN,
            "keeps the last",
            "watchdog.enabled: true",
        ),
        ({"drive": {"command_timeout": 0.0}}, Verdict.WARN, "command_timeout of effort", "command_timeout: 0.1"),
        ({"drive": {"command_timeout": 0.2}}, Verdict.PASS, "command_timeout = 0.2 s", ""),
        ({"drive": {}}, Verdict.PASS, "no timeout", ""),
    ],
)
def test_a_drives_own_timeout_is_recommended_where_it_has_one(changes, verdict, found, fix):
    finding = stack.commands_end(changed(**changes))
    assert finding.verdict is verdict and found in finding.found and fix in finding.fix


@pytest.mark.parametrize("topic", ALONE, ids=lambda topic: topic.name)
def test_topics_that_must_have_one_publisher(topic):
    finding = stack.topic(with_another(topic), topic)
    assert finding.verdict is Verdict.FAIL and "end /stranger" in finding.fix and "2 publishers" in finding.found
    finding = stack.topic(with_publishers(topic), topic)
    assert finding.verdict is Verdict.FAIL and "start" in finding.fix


def test_kukas_adapter_needs_no_effort_controller():
    graph = with_publishers(topics.COMMANDS)
    kuka = dataclasses.replace(graph, settings={"adapter": {"kind": "lbr"}})
    assert stack.topic(kuka, topics.COMMANDS).verdict is Verdict.PASS
    assert stack.topic(graph, topics.COMMANDS).verdict is Verdict.FAIL


BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize(
    ("topic", "changes", "found", "fix"),
    [
        (topics.GOAL_POSE, {"type_name": "geometry_msgs/msg/Pose"}, "geometry_msgs/msg/Pose", "PoseStamped"),
        (topics.GOAL_POSE, {"qos": BEST_EFFORT}, "/planner gets nothing from /stranger", "reliable"),
        (topics.SAFETY_STATE, {"qos": qos_profile(topics.STREAM)}, "/stranger", "transient local"),
    ],
)
def test_types_and_qualities_of_service_that_do_not_match(topic, changes, found, fix):
    finding = stack.topic(with_another(topic, **changes), topic)
    assert finding.verdict is Verdict.FAIL and found in finding.found and fix in finding.fix


def test_obstacles_need_not_be_latched():
    topic = topics.OBSTACLES
    finding = stack.topic(with_another(topic, qos=qos_profile(topics.STREAM)), topic)
    assert finding.verdict is Verdict.PASS
