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

LOOK_S = 1.0
"""Time in which a node has mostly been discovered; bring-up looks again before it starts the control loop."""
_POLL_S = 0.02
_SUPERVISORS = ("bringup", "demo")
_DOMAINS = 102
"""Domains whose ports Linux does not also give to other programs."""


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


def refuse_beside_another(node: Node, planned: Collection[str], since: float) -> None:
    """Look for another stack until `LOOK_S` after `since`, on the monotonic clock.

    Raises `InputError` if there is one, with its nodes, the domain, and how to choose another.
    """
    found = running(node, planned)
    while not found and time.monotonic() < since + LOOK_S:
        time.sleep(_POLL_S)
        found = running(node, planned)
    if found:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        other = (int(domain) + 1) % _DOMAINS if domain.isdigit() else 1
        raise InputError(
            f"a stack is already running in ROS domain {domain}: {', '.join(found)}. A second one would stop its arm: "
            f"end it, or start this one in another domain: export ROS_DOMAIN_ID={other}, or in a namespace"
        )
