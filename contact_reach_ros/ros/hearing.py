"""Finds the controllers that receive a node's plans: a plan sent before discovery has matched them is lost silently."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.graph_names import UNKNOWN_NODE, node_of

_COMMANDS = (topics.COMMANDS, topics.ADAPTER_COMMANDS, topics.SHADOW_COMMANDS)


def commanders_that_hear(node: Node, wanted: Iterable[Topic]) -> list[str]:
    """Full names of the nodes that publish commands, for driver, adapter or nobody, and hear all of these topics."""
    names = set().union(*(_names(node.get_publishers_info_by_topic(topic.name)) for topic in _COMMANDS))
    for topic in wanted:
        names &= _names(node.get_subscriptions_info_by_topic(topic.name))
    return sorted(names)


def _names(endpoints: Sequence[TopicEndpointInfo]) -> set[str]:
    return {node_of(info) for info in endpoints if info.node_name != UNKNOWN_NODE}
