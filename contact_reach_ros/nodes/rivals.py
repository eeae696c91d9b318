"""Whether somebody else publishes what only one node may."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.topics import Topic

LOOK_AROUND_S = 0.25
"""How often a node looks."""

_OWNERS = {
    topics.COMMANDS.name: "the controller",
    topics.REFERENCE_POSE.name: "the planner",
    topics.REFERENCE_POSTURE.name: "the planner",
}


def rivalry(node: Node, exclusive: Iterable[Topic]) -> str:
    """Which of these topics have more than one publisher, and who they are; empty if none has."""
    reasons = []
    for topic in exclusive:
        if node.count_publishers(topic.name) > 1:
            publishers = node.get_publishers_info_by_topic(topic.name)
            names = sorted(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in publishers)
            owner = _OWNERS[topic.name]
            reasons.append(f"{len(names)} publishers on {topic.name} ({', '.join(names)}), expected {owner} alone")
    return "; ".join(reasons)
