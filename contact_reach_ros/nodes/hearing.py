"""Who hears a node: a plan that is sent before its receiver has been found is lost, and nobody says so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.topics import Topic

UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""What the graph calls the node of an endpoint that has been found before its node has."""

_COMMANDS = (topics.COMMANDS, topics.SHADOW_COMMANDS)


def commanders_that_hear(node: Node, wanted: Iterable[Topic]) -> list[str]:
    """Full names of the nodes that command the arm, or would, and subscribe to all of these topics, as `node` knows."""
    names = set().union(*(_names(node.get_publishers_info_by_topic(topic.name)) for topic in _COMMANDS))
    for topic in wanted:
        names &= _names(node.get_subscriptions_info_by_topic(topic.name))
    return sorted(names)


def _names(endpoints: Sequence[TopicEndpointInfo]) -> set[str]:
    known = (info for info in endpoints if info.node_name != UNKNOWN_NODE)
    return {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in known}
