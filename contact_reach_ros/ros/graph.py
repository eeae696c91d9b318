"""Who publishes and hears what in the ROS graph: names of nodes, rivals of a topic, and stacks that run already.

A node that was killed stays in the graph until its lease runs out, 20 s by default: until then a second one of its name
counts as its rival.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Iterable, Sequence

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.interfaces import ALONE, MANAGED

UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Name in the graph of a node that was discovered later than its endpoint."""

LOOK_AROUND_S = 0.25
"""Period of the check."""

LOOK_S = 1.0
"""Time in which a node has mostly been discovered; bring-up looks again before it starts the control loop."""
_POLL_S = 0.02
_SUPERVISORS = ("bringup", "demo")
_DOMAINS = 102
"""Domains whose ports Linux does not also give to other programs."""

_COMMANDS = (topics.COMMANDS, topics.ADAPTER_COMMANDS, topics.SHADOW_COMMANDS)


def full_name(namespace: str, name: str) -> str:
    """Join a namespace and a name in it."""
    return f"{namespace.rstrip('/')}/{name}"


def node_of(endpoint: TopicEndpointInfo) -> str:
    """Return the full name of the node that publishes or subscribes; it may end in `UNKNOWN_NODE`."""
    return full_name(endpoint.node_namespace, endpoint.node_name)


def commanders_that_hear(node: Node, wanted: Iterable[Topic]) -> list[str]:
    """Full names of the nodes that publish commands, for driver, adapter or nobody, and hear all of these topics."""
    names = set().union(*(_names(node.get_publishers_info_by_topic(topic.name)) for topic in _COMMANDS))
    for topic in wanted:
        names &= _names(node.get_subscriptions_info_by_topic(topic.name))
    return sorted(names)


def _names(endpoints: Sequence[TopicEndpointInfo]) -> set[str]:
    return {node_of(info) for info in endpoints if info.node_name != UNKNOWN_NODE}


def rivalry(node: Node, exclusive: Iterable[Topic]) -> str:
    """Name these topics that have more publishers than they may, and the publishers; empty if none has.

    Topics are meant by the names that they have for `node`, after its namespace and remappings. One of `ALONE`, or one
    that `MANAGED` does not list, may have one publisher, whatever its name; another one the nodes that `MANAGED` lists
    for it, each once.
    """
    reasons = []
    for topic in exclusive:
        resolved = node.resolve_topic_name(topic.name)
        owners = [name for name, interface in MANAGED.items() if topic.name in interface.publishes]
        is_alone = topic in ALONE or not owners
        if is_alone and node.count_publishers(resolved) < 2:
            continue
        publishers = node.get_publishers_info_by_topic(resolved)
        if is_alone:
            is_wrong, expected = len(publishers) > 1, f"the {' or '.join(owners or [node.get_name()])} alone"
        else:
            is_wrong = _has_strangers(Counter(info.node_name for info in publishers), owners)
            expected = f"one each of {', '.join(owners)}"
        if is_wrong:
            names = sorted(map(node_of, publishers))
            reasons.append(f"{len(names)} publishers on {resolved} ({', '.join(names)}), expected {expected}")
    return "; ".join(reasons)


def _has_strangers(counts: Counter[str], owners: list[str]) -> bool:
    """Whether there are nodes besides the owners, or two of a name; `counts` is the number of nodes by name."""
    # An endpoint is discovered before its node: one without a name may be an owner that is not seen yet.
    unknown = counts.pop(UNKNOWN_NODE, 0)
    missing = sum(name not in counts for name in owners)
    return unknown > missing or any(name not in owners or count > 1 for name, count in counts.items())


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
    mine = {node.get_name(): 1, **dict.fromkeys(own, 1)}
    space = node.get_namespace()
    names = Counter(name for name, other in node.get_node_names_and_namespaces() if other == space)
    found = {full_name(space, name) for name in (*planned, *_SUPERVISORS) if names[name] > mine.get(name, 0)}
    for topic in ALONE:
        if any(topic.name in MANAGED[name].publishes for name in planned):
            publishers = node.get_publishers_info_by_topic(topic.name)
            found |= {
                f"{node_of(info)} (on {topic.name})"
                for info in publishers
                if info.node_name != UNKNOWN_NODE and (info.node_namespace != space or info.node_name not in planned)
            }
    return sorted(found)


def refuse_beside_another(node: Node, planned: Collection[str], since: float, own: Collection[str] = ()) -> None:
    """Look for another stack, as `running` does, until `LOOK_S` after `since`, on the monotonic clock.

    Raises `InputError` if there is one, with its nodes, the domain, and how to choose another.
    """
    found = running(node, planned, own)
    while not found and time.monotonic() < since + LOOK_S:
        time.sleep(_POLL_S)
        found = running(node, planned, own)
    if found:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        other = (int(domain) + 1) % _DOMAINS if domain.isdigit() else 1
        raise InputError(
            f"a stack is already running in ROS domain {domain}: {', '.join(found)}. A second one would stop its arm: "
            f"end it, or start this one in another domain: export ROS_DOMAIN_ID={other}, or in a namespace"
        )
