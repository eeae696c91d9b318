"""A look at a running stack that does not disturb it: its graph, and the messages of a second."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.doctor.arm import JointRecord, Stamps
from contact_reach_ros.doctor.stack import Endpoint, Graph
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.safety_state import ERROR, read_level, requires_observer
from contact_reach_ros.messages.values import nanoseconds, read_settings
from contact_reach_ros.ros.discovery import wait_until_settled
from contact_reach_ros.ros.graph import UNKNOWN_NODE, full_name, node_of
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.ros.interfaces import ADAPTER, DOCTOR, MANAGED
from contact_reach_ros.ros.process import bare_node

EFFORT_CONTROLLER = "effort_controller"
"""Name of the ros2_control controller that takes the commands, where there is one."""

_KEPT = (topics.SAFETY_STATE, topics.SETTINGS)
"""Latched topics of several nodes, of which what came before counts as well."""

_ANYTHING = topics.Qos(2000, reliable=False)
"""Matches every publisher."""

_LOOK_S = 0.1
_ANSWER_S = 3.0
_FIRST_STATE_S = 3.0
_MATCHING_S = 0.3
_DRAIN_S = 0.01


class Message(NamedTuple):
    """One message as it came: its bytes, and when, on the system clock."""

    data: bytes
    received_ns: int


def look_around(discovery: str, seconds: float, arm: Arm) -> Look:
    """Look at the stack with a node of its own; raises `ContactReachError` if ROS does not start a node.

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
        return Look(node, seconds, arm)


class Look:
    """What the checks need to know of a running stack.

    Attributes
    ----------
    graph
        Nodes, topics and states.
    messages
        What was heard, by topic.
    command_order
        Parameter `joints` of a ros2_control controller that takes the controller's commands; None without one.
    """

    def __init__(self, node: Node, seconds: float, arm: Arm) -> None:
        self._node = node
        self._arm = arm
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.messages: dict[str, list[Message]] = {}
        self.command_order: Sequence[str] | None = None
        wait_until_settled(self._seen, lambda: self._executor.spin_once(timeout_sec=_LOOK_S))
        names, states, simulated = self._nodes(), {}, {}
        if Graph(names, self._publishers()).running:
            for name in (name for name in MANAGED if f"/{name}" in names):
                states[name] = self._state(name)
                # A silent node is not asked again.
                value = self._parameter(name, "use_sim_time") if states[name] else None
                if value is not None:
                    simulated[name] = bool(value.bool_value)
            # The adapter puts commands into the controller's order.
            if f"/{EFFORT_CONTROLLER}" in names and f"/{ADAPTER}" not in names:
                value = self._parameter(EFFORT_CONTROLLER, "joints")
                self.command_order = list(value.string_array_value) if value is not None else None
            self._listen(seconds)
        subscriptions = {
            topic.name: _endpoints(node.get_subscriptions_info_by_topic(topic.name)) for topic in topics.ALL
        }
        newest = self._newest(topics.SAFETY_STATE)
        stops = [(name, status.message, read_level(status) >= ERROR) for name, status in newest.items()]
        is_watched = all(requires_observer(status) for status in newest.values())
        settings = {name: read_settings(status) for name, status in self._newest(topics.SETTINGS).items()}
        self.graph = Graph(
            self._nodes(), self._publishers(), subscriptions, states, simulated, stops, is_watched, settings
        )
        self._executor.shutdown()

    def joint_record(self) -> JointRecord:
        """Return the joint states that came."""
        heard = self.messages.get(topics.JOINT_STATES.name, [])
        states = [deserialize_message(message.data, JointState) for message in heard]
        names = tuple(dict.fromkeys(tuple(state.name) for state in states))
        return JointRecord(
            names,
            np.array([nanoseconds(state.header.stamp) for state in states], dtype=np.int64),
            np.array([message.received_ns for message in heard], dtype=np.int64),
            *(
                np.array([self._in_order(state, field) for state in states]).reshape(-1, self._arm.n)
                for field in ("position", "velocity", "effort")
            ),
        )

    def clock_at_states(self) -> Stamps | None:
        """Return the simulated time when each joint state came, (n,) ns, or None in real time."""
        clocks = self.messages.get(topics.CLOCK.name, [])
        if not self.graph.publishers.get(topics.CLOCK.name) or not clocks:
            return None
        times = np.array([nanoseconds(deserialize_message(message.data, Clock).clock) for message in clocks])
        received = [message.received_ns for message in clocks]
        states = [message.received_ns for message in self.messages.get(topics.JOINT_STATES.name, [])]
        return times[np.clip(np.searchsorted(received, states) - 1, 0, None)]

    def _listen(self, seconds: float) -> None:
        # What is too large to be handled by a node counts for nothing here.
        inbox = Inbox(self._node, lambda what, error: None)
        for topic in topics.ALL:
            infos = self._node.get_publishers_info_by_topic(topic.name)
            if any(info.topic_type == topic.type_name for info in infos):
                heard: list[Message] = []
                self.messages[topic.name] = heard
                qos = topics.ALL_EVENTS if topic in _KEPT else _ANYTHING
                inbox.add(topic, functools.partial(_keep, inbox, heard), qos, serialized=True)

        def drain(until: float) -> None:
            while time.monotonic() < until:
                time.sleep(_DRAIN_S)
                inbox.poll()

        patience = time.monotonic() + _FIRST_STATE_S
        states = self.messages.get(topics.JOINT_STATES.name)
        while states is not None and not states and time.monotonic() < patience:
            drain(time.monotonic() + _DRAIN_S)
        drain(time.monotonic() + _MATCHING_S)
        # What came before every subscription was matched is no measure of rates.
        for name, heard in self.messages.items():
            if name not in [topic.name for topic in _KEPT]:
                heard.clear()
        drain(time.monotonic() + seconds)

    def _newest(self, topic: topics.Topic) -> dict[str, DiagnosticStatus]:
        """The newest status of each node on a topic of statuses."""
        newest: dict[str, DiagnosticStatus] = {}
        for message in self.messages.get(topic.name, []):
            status = deserialize_message(message.data, DiagnosticStatus)
            newest[status.name] = status
        return newest

    def _seen(self) -> tuple[list[str], list[int]]:
        return self._nodes(), [self._node.count_publishers(topic.name) for topic in topics.ALL]

    def _nodes(self) -> list[str]:
        found = (full_name(namespace, name) for name, namespace in self._node.get_node_names_and_namespaces())
        return sorted(name for name in found if name != f"/{DOCTOR}")

    def _publishers(self) -> dict[str, list[Endpoint]]:
        return {topic.name: _endpoints(self._node.get_publishers_info_by_topic(topic.name)) for topic in topics.ALL}

    def _state(self, name: str) -> str:
        response = self._call(GetState, f"/{name}/get_state", GetState.Request())
        return response.current_state.label if response is not None else ""

    def _parameter(self, name: str, parameter: str) -> Any:
        response = self._call(GetParameters, f"/{name}/get_parameters", GetParameters.Request(names=[parameter]))
        return response.values[0] if response is not None and response.values else None

    def _call(self, kind: Any, service: str, request: Any) -> Any:
        client = self._node.create_client(kind, service)
        try:
            if not client.wait_for_service(timeout_sec=_ANSWER_S):
                return None
            future = client.call_async(request)
            self._executor.spin_until_future_complete(future, timeout_sec=_ANSWER_S)
            return future.result() if future.done() else None
        finally:
            self._node.destroy_client(client)

    def _in_order(self, state: JointState, field: str) -> list[float]:
        """Values of the arm's joints in its order, NaN for those that a message lacks."""
        values = dict(zip(state.name, getattr(state, field), strict=False))
        return [values.get(joint, float("nan")) for joint in self._arm.joint_names]


def _keep(inbox: Inbox, heard: list[Message], data: bytes) -> None:
    heard.append(Message(data, inbox.received_ns or time.time_ns()))


def _endpoints(infos: Sequence[TopicEndpointInfo]) -> list[Endpoint]:
    return [Endpoint(_node_name(info), info.topic_type, info.qos_profile) for info in infos if info.node_name != DOCTOR]


def _node_name(info: TopicEndpointInfo) -> str:
    return "an unknown node" if info.node_name == UNKNOWN_NODE else node_of(info)
