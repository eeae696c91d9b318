"""Names of nodes in the ROS graph."""

from __future__ import annotations

from rclpy.topic_endpoint_info import TopicEndpointInfo

UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Name in the graph of a node that was discovered later than its endpoint."""


def full_name(namespace: str, name: str) -> str:
    """Join a namespace and a name in it."""
    return f"{namespace.rstrip('/')}/{name}"


def node_of(endpoint: TopicEndpointInfo) -> str:
    """Return the full name of the node that publishes or subscribes; it may end in `UNKNOWN_NODE`."""
    return full_name(endpoint.node_namespace, endpoint.node_name)
