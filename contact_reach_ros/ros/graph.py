"""Who publishes and hears what in the ROS graph: names of nodes, rivals of a topic, and stacks that run already.

A node that was killed stays in the graph until its lease runs out, 20 s by default: until then a second one of its name
counts as its rival.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from copy import copy

from rclpy.duration import Infinite
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.interfaces import ALONE, OWNERS, RECORDER

_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Name in the graph of a node that was discovered later than its endpoint."""

LOOK_AROUND_S = 0.25
"""Period of the check."""

_LOOK_S = 1.0
"""Time in which a node has mostly been discovered; bring-up looks again before it starts the control loop."""
_POLL_S = 0.02
_SUPERVISORS = ("bringup", "demo")

_COMMANDS = (topics.COMMANDS, topics.ADAPTER_COMMANDS, topics.SHADOW_COMMANDS)


def full_name(namespace: str, name: str) -> str:
    """Join a namespace and a name in it."""
    return f"{namespace.rstrip('/')}/{name}"


def node_of(endpoint: TopicEndpointInfo) -> str:
    """Return the full name of the node that publishes or subscribes; it may end in `_UNKNOWN_NODE`."""
    return full_name(endpoint.node_namespace, endpoint.node_name)


def controllers(node: Node) -> list[str]:
    """Full names of the nodes that publish commands, for driver, adapter or nobody, and hear both halves of a plan."""
    names = set().union(*(_names(node.get_publishers_info_by_topic(topic.name)) for topic in _COMMANDS))
    for topic in (topics.REFERENCE_POSE, topics.REFERENCE_POSTURE):
        names &= _names(node.get_subscriptions_info_by_topic(topic.name))
    return sorted(names)


def _names(endpoints: Sequence[TopicEndpointInfo]) -> set[str]:
    return {node_of(info) for info in endpoints if info.node_name != _UNKNOWN_NODE}


def goal_topic(node: Node, planner: str) -> str:
    """Full name of the topic from which the planner of this name takes goals; empty until it is discovered."""
    try:
        heard = node.get_subscriber_names_and_types_by_node(planner, node.get_namespace())
    except NodeNameNonExistentError:
        return ""
    return next((name for name, types in heard if topics.GOAL_POSE.type_name in types), "")


def takes_commands(node: Node, controller: str) -> bool:
    """Whether a node that takes the commands of the controller of this name is discovered: a driver or an adapter.

    True also with `supervision.shadow`, whose commands nobody takes.
    """
    try:
        published = node.get_publisher_names_and_types_by_node(controller, node.get_namespace())
    except NodeNameNonExistentError:
        return False
    names = [name for name, types in published if topics.COMMANDS.type_name in types]
    takers = {info.node_name for name in names for info in node.get_subscriptions_info_by_topic(name)}
    return any(name.endswith(topics.SHADOW_COMMANDS.name) for name in names) or bool(takers - {RECORDER, _UNKNOWN_NODE})


def rivalry(node: Node, exclusive: Iterable[Topic]) -> str:
    """Name these topics that have more publishers than they may, and the publishers; empty if none has.

    Topics are meant by the names that they have for `node`, after its namespace and remappings. One of `ALONE`, or one
    that `OWNERS` does not list, may have one publisher, whatever its name; another one its owners, each once.
    """
    reasons = []
    for topic in exclusive:
        resolved = node.resolve_topic_name(topic.name)
        owners = OWNERS.get(topic.name, ())
        is_alone = topic in ALONE or not owners
        most = 1 if is_alone else len(owners)
        if is_alone and node.count_publishers(resolved) <= most:
            continue
        publishers = node.get_publishers_info_by_topic(resolved)
        # One whose node is not discovered yet may be an owner.
        known = Counter(info.node_name for info in publishers if info.node_name != _UNKNOWN_NODE)
        if len(publishers) > most or (not is_alone and known - Counter(owners)):
            names = sorted(map(node_of, publishers))
            alone = f"the {' or '.join(owners or [node.get_name()])} alone"
            expected = alone if is_alone else f"one each of {', '.join(owners)}"
            reasons.append(f"{len(names)} publishers on {resolved} ({', '.join(names)}), expected {expected}")
    return "; ".join(reasons)


def mismatches(node: Node, heard: Iterable[Subscription], counts: dict[tuple[str, str], int]) -> Iterator[str]:
    """Yield a line for each endpoint that the quality of service keeps from the node's publishers or the subscriptions.

    `counts` holds the numbers of endpoints at the last look, and is updated: it looks again where they have changed.
    """
    requested: dict[str, list[QoSProfile]] = {}
    for each in heard:
        requested.setdefault(each.topic_name, []).append(each.qos_profile)
    offered = {publisher.topic_name: [as_offered(publisher.qos_profile)] for publisher in node.publishers}
    for profiles, count, look, what, remedy in (
        (requested, node.count_publishers, node.get_publishers_info_by_topic, "hears nothing from", "offer"),
        (offered, node.count_subscribers, node.get_subscriptions_info_by_topic, "is not heard by", "request at most"),
    ):
        for name, own in profiles.items():
            before, counts[name, what] = counts.get((name, what)), count(name)
            for other in look(name) if counts[name, what] != before else ():
                order = 1 if profiles is requested else -1
                found = [qos_check_compatible(*(other.qos_profile, mine)[::order]) for mine in own]
                # Several subscriptions to a topic complement each other.
                if all(compatible == QoSCompatibility.ERROR for compatible, _ in found):
                    words = f"{own[0].reliability.name}, {own[0].durability.name}".lower().replace("_", " ")
                    why = found[0][1].strip().rstrip(";")
                    yield f"{name}: this node {what} {node_of(other)} ({why}); let that one {remedy} {words}"


def as_offered(profile: QoSProfile) -> QoSProfile:
    """What a publisher of ours offers, as the graph has it: durations that are not set are infinite."""
    profile = copy(profile)
    profile.deadline = profile.liveliness_lease_duration = Infinite
    return profile


def running(node: Node, planned: Collection[str], own: Collection[str] = ()) -> list[str]:
    """Full names of the nodes that already run under a planned name, or publish in the place of a planned node.

    Parameters
    ----------
    node
        Looks at the graph, in its namespace; it counts as own.
    planned
        Names of the nodes that are to be started.
    own
        Names of those of them that are running, as children of this process.
    """
    space = node.get_namespace()
    here = Counter(name for name, other in node.get_node_names_and_namespaces() if other == space)
    others = here - Counter([node.get_name(), *own])
    found = {full_name(space, name) for name in (*planned, *_SUPERVISORS) if name in others}
    ours = {full_name(space, name) for name in planned}
    for topic in ALONE:
        if not {*planned}.isdisjoint(OWNERS[topic.name]):
            strangers = _names(node.get_publishers_info_by_topic(topic.name)) - ours
            found |= {f"{name} (on {topic.name})" for name in strangers}
    return sorted(found)


def refuse_beside_another(
    node: Node, planned: Collection[str], own: Collection[str] = (), patience: float = _LOOK_S
) -> None:
    """Look for another stack, as `running` does, for some time, s.

    Raises `InputError` if there is one, with its nodes, the domain, and what to choose instead.
    """
    end = time.monotonic() + patience
    found = running(node, planned, own)
    while not found and time.monotonic() < end:
        time.sleep(_POLL_S)
        found = running(node, planned, own)
    if found:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        raise InputError(
            f"a stack is already running in ROS domain {domain}: {', '.join(found)}. A second one would stop its arm: "
            "end it, or start this one in another domain (export ROS_DOMAIN_ID=N) or in a namespace"
        )
