"""A look at a running stack that does not disturb it: its graph, and the messages of a second."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.doctor.arm import JointRecord
from contact_reach_ros.doctor.stack import Endpoint, Graph
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.safety_state import ERROR, read_level, requires_observer
from contact_reach_ros.messages.values import nanoseconds, read_settings
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.graph import full_name, node_of
from contact_reach_ros.ros.interfaces import ADAPTER, DOCTOR, MANAGED
from contact_reach_ros.ros.process import bare_node

_EFFORT_CONTROLLER = "effort_controller"
"""Name of the ros2_control controller that takes the commands, where there is one."""

_LATCHED = (topics.SAFETY_STATE, topics.SETTINGS)
"""Topics of several nodes, of which what came before counts as well."""
_HEARD = (*_LATCHED, topics.JOINT_STATES)
_ANYTHING = topics.Qos(2000, reliable=False)
"""Matches every publisher."""

_SETTLED_S = 3.5
"""A participant announces itself every three seconds; where the first answer was lost it is found no sooner."""
_MATCHING_S = 1.0

Heard = dict[str, list[tuple[bytes, int]]]
"""Messages by topic: the bytes of each, and its arrival on the system clock, ns."""


def look_around(discovery: str, seconds: float, arm: Arm) -> tuple[Graph, JointRecord]:
    """Look at the stack with a node of its own; returns its graph and the joint states that came.

    Raises `ContactReachError` if ROS does not start a node.

    Parameters
    ----------
    discovery
        How far to look, one of `discovery.CHOICES`.
    seconds
        How long to listen, if anything is there.
    arm
        Whose joint states are expected.
    """
    with bare_node(DOCTOR, discovery) as node:
        client = Client(node)
        time.sleep(_SETTLED_S)
        names, states, order = _nodes(node), {}, None
        for name in (name for name in MANAGED if f"/{name}" in names):
            answer = _ask(client, f"/{name}/get_state", GetState, GetState.Request())
            states[name] = answer.current_state.label if answer is not None else ""
        # The adapter puts commands into the controller's order.
        if f"/{_EFFORT_CONTROLLER}" in names and f"/{ADAPTER}" not in names:
            request = GetParameters.Request(names=["joints"])
            answer = _ask(client, f"/{_EFFORT_CONTROLLER}/get_parameters", GetParameters, request)
            order = list(answer.values[0].string_array_value) if answer is not None and answer.values else None
        heard = _listen(client, seconds)
        safety, settings = (_newest(heard[topic.name]) for topic in _LATCHED)
        graph = Graph(
            _nodes(node),
            {topic.name: _endpoints(node.get_publishers_info_by_topic(topic.name)) for topic in topics.ALL},
            {topic.name: _endpoints(node.get_subscriptions_info_by_topic(topic.name)) for topic in topics.ALL},
            states,
            [(name, status.message, read_level(status) >= ERROR) for name, status in safety.items()],
            all(requires_observer(status) for status in safety.values()),
            {name: read_settings(status) for name, status in settings.items()},
            order,
        )
        client.close()
    return graph, _joint_record(heard[topics.JOINT_STATES.name], arm)


def _ask(client: Client, service: str, kind: Any, request: Any) -> Any:
    """The answer of a service; None without any."""
    try:
        return client.call(service, kind, request)
    except ContactReachError:
        return None


def _listen(client: Client, seconds: float) -> Heard:
    inbox = client.inbox
    heard: Heard = {topic.name: [] for topic in _HEARD}

    def keep(name: str, data: bytes) -> None:
        heard[name].append((data, inbox.received_ns or time.time_ns()))

    for topic in _HEARD:
        infos = client.node.get_publishers_info_by_topic(topic.name)
        if any(info.topic_type == topic.type_name for info in infos):
            qos = topics.ALL_EVENTS if topic in _LATCHED else _ANYTHING
            inbox.add(topic, partial(keep, topic.name), qos, serialized=True)
    # What comes before every subscription is matched is no measure of rates.
    client.spin(_MATCHING_S)
    heard[topics.JOINT_STATES.name].clear()
    client.spin(seconds)
    return heard


def _newest(messages: Sequence[tuple[bytes, int]]) -> dict[str, DiagnosticStatus]:
    """The newest status of each node on a topic of statuses."""
    statuses = [deserialize_message(data, DiagnosticStatus) for data, _ in messages]
    return {status.name: status for status in statuses}


def _joint_record(messages: Sequence[tuple[bytes, int]], arm: Arm) -> JointRecord:
    states = [deserialize_message(data, JointState) for data, _ in messages]

    def column(name: str) -> Any:
        """Values of the arm's joints in its order, NaN for those that a message lacks."""
        read = [dict(zip(state.name, getattr(state, name), strict=False)) for state in states]
        return np.array([[each.get(joint, np.nan) for joint in arm.joint_names] for each in read]).reshape(-1, arm.n)

    return JointRecord(
        tuple(dict.fromkeys(tuple(state.name) for state in states)),
        np.array([nanoseconds(state.header.stamp) for state in states], dtype=np.int64),
        np.array([received_ns for _, received_ns in messages], dtype=np.int64),
        column("position"),
        column("velocity"),
        column("effort"),
    )


def _nodes(node: Node) -> list[str]:
    found = (full_name(namespace, name) for name, namespace in node.get_node_names_and_namespaces())
    return sorted(name for name in found if name != f"/{DOCTOR}")


def _endpoints(infos: Sequence[TopicEndpointInfo]) -> list[Endpoint]:
    return [Endpoint(node_of(info), info.topic_type, info.qos_profile) for info in infos if info.node_name != DOCTOR]
