"""Notices a stack that runs already: a second one in its ROS domain would stop its arm."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection

from rclpy.node import Node

from contact_reach_ros.errors import InputError
from contact_reach_ros.ros.graph import UNKNOWN_NODE, full_name, node_of
from contact_reach_ros.ros.interfaces import ALONE, MANAGED
from contact_reach_ros.ros.node_processes import node_processes

LOOK_S = 0.5
"""Time in which the first node of another host, or of another package, has mostly been discovered."""
_POLL_S = 0.02
_SUPERVISORS = ("bringup", "demo")
_DOMAINS = 102
"""Domains whose ports Linux does not also give to other programs."""


def running(node: Node, planned: Collection[str], own: Collection[str] = ()) -> list[str]:
    """What runs already of what is to be started, or publishes in its place.

    Parameters
    ----------
    node
        Whose graph is looked at, in its namespace; it counts as own.
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


def refuse_beside_another(node: Node, planned: Collection[str], since: float) -> None:
    """Look for another stack until `LOOK_S` after `since`, on the monotonic clock.

    A stack of this package on this machine is found at once, by its processes. Raises `InputError` if there is one,
    with its nodes, the domain, and how to choose another.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    space = node.get_namespace()
    processes = node_processes(domain, namespace=space)
    processes.pop(os.getpid(), None)
    found = sorted(full_name(space, name) for name in {*processes.values()} & {*planned, *_SUPERVISORS})
    while not found and time.monotonic() < since + LOOK_S:
        time.sleep(_POLL_S)
        found = running(node, planned)
    if found:
        other = (int(domain) + 1) % _DOMAINS if domain.isdigit() else 1
        raise InputError(
            f"a stack is already running in ROS domain {domain}: {', '.join(found)}. A second one would stop its arm: "
            f"end it, or start this one in another domain: export ROS_DOMAIN_ID={other}, or in a namespace"
        )
