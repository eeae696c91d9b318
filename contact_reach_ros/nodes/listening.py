"""A look at a running stack that leaves it alone: its graph, and what its topics carry for a second."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from contact_reach_ros.doctor.arm import JointRecord
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.discovery import wait_until_settled
from contact_reach_ros.nodes.graph_checks import Endpoint, Graph, type_name
from contact_reach_ros.nodes.hearing import UNKNOWN_NODE
from contact_reach_ros.nodes.interfaces import DOCTOR, MANAGED
from contact_reach_ros.nodes.messages import nanoseconds
from contact_reach_ros.nodes.realtime import LoopGroup
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.units import NANOSECONDS

EFFORT_CONTROLLER = "effort_controller"
"""Name of the ros2_control controller that takes the commands, where there is one."""

_DEEP = 2000
_EVERYTHING = QoSProfile(depth=_DEEP, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches every publisher."""

_LOOK_S = 0.1
_ANSWER_S = 3.0
_FIRST_STATE_S = 3.0
_DRAIN_S = 0.01


class Message(NamedTuple):
    """One message as it came: its bytes, and when, on the system clock."""

    data: bytes
    received_ns: int


class Look:
    """Everything that the checks need to know of a running stack.

    Attributes
    ----------
    graph
        Nodes, topics and states.
    messages
        What was heard, by topic.
    command_order
        Parameter `joints` of a ros2_control controller that takes the commands; None without one.
    """

    def __init__(self, node: Node, seconds: float) -> None:
        """Look around, and listen for some seconds if anything is there."""
        self._node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self.messages: dict[str, list[Message]] = {}
        self.command_order: Sequence[str] | None = None
        wait_until_settled(self._seen, lambda: self._executor.spin_once(timeout_sec=_LOOK_S))
        names, states, simulated = self._nodes(), {}, {}
        if Graph(names, self._publishers()).running:
            for name in (name for name in MANAGED if f"/{name}" in names):
                states[name] = self._state(name)
                # One that is silent is asked no more.
                value = self._parameter(name, "use_sim_time") if states[name] else None
                if value is not None:
                    simulated[name] = bool(value.bool_value)
            if f"/{EFFORT_CONTROLLER}" in names:
                value = self._parameter(EFFORT_CONTROLLER, "joints")
                self.command_order = list(value.string_array_value) if value is not None else None
            self._listen(seconds)
        subscriptions = {
            topic.name: self._endpoints(node.get_subscriptions_info_by_topic(self._full(topic.name)))
            for topic in topics.ALL
        }
        self.graph = Graph(self._nodes(), self._publishers(), subscriptions, states, simulated, self._safety())
        self._executor.shutdown()

    def joint_record(self) -> JointRecord:
        """The joint states that came."""
        heard = self.messages.get(topics.JOINT_STATES.name, [])
        states = [deserialize_message(message.data, JointState) for message in heard]
        names = tuple(dict.fromkeys(tuple(state.name) for state in states))
        return JointRecord(
            names,
            np.array([nanoseconds(state.header.stamp) for state in states], dtype=np.int64),
            np.array([message.received_ns for message in heard], dtype=np.int64),
            *(
                np.array([_in_order(state, field) for state in states]).reshape(-1, iiwa14.N_JOINTS)
                for field in ("position", "velocity", "effort")
            ),
        )

    def clock_at_states(self) -> np.ndarray | None:
        """(n,) simulated time in ns when each joint state came, or None in real time."""
        clocks = self.messages.get(topics.CLOCK.name, [])
        if not self.graph.publishers.get(topics.CLOCK.name) or not clocks:
            return None
        times = np.array([nanoseconds(deserialize_message(message.data, Clock).clock) for message in clocks])
        received = [message.received_ns for message in clocks]
        states = [message.received_ns for message in self.messages.get(topics.JOINT_STATES.name, [])]
        return times[np.clip(np.searchsorted(received, states) - 1, 0, None)]

    def bytes_per_second(self) -> float | None:
        """Of all recorded topics, on the arm's clock; None if too little was heard, or nobody commands the arm yet."""
        stamps = self.joint_record().stamps_ns
        span = float(stamps[-1] - stamps[0]) / NANOSECONDS if len(stamps) > 1 else 0.0
        if span < 0.1 or not self.messages.get(topics.COMMANDS.name):
            return None
        return sum(len(message.data) for heard in self.messages.values() for message in heard) / span

    def _listen(self, seconds: float) -> None:
        group = LoopGroup()
        subscriptions = {}
        for topic in topics.ALL:
            infos = self._node.get_publishers_info_by_topic(self._full(topic.name))
            if any(info.topic_type == type_name(topic) for info in infos):
                qos = topics.ALL_EVENTS if topic is topics.SAFETY_STATE else _EVERYTHING
                subscriptions[topic.name] = (
                    topic.type,
                    self._node.create_subscription(
                        topic.type, topic.name, lambda _: None, qos, callback_group=group, raw=True
                    ),
                )
        self.messages = {name: [] for name in subscriptions}

        def drain(until: float) -> None:
            while time.monotonic() < until:
                time.sleep(_DRAIN_S)
                for name, (kind, subscription) in subscriptions.items():
                    while (taken := subscription.handle.take_message(kind, True)) is not None:
                        data, about = taken
                        self.messages[name].append(Message(data, about["received_timestamp"] or time.time_ns()))

        patience = time.monotonic() + _FIRST_STATE_S
        states = self.messages.get(topics.JOINT_STATES.name)
        while states is not None and not states and time.monotonic() < patience:
            drain(time.monotonic() + _DRAIN_S)
        # What came before every subscription was matched is no measure of rates.
        safety = self.messages.get(topics.SAFETY_STATE.name, [])
        drain(time.monotonic() + 0.3)
        for name, heard in self.messages.items():
            if name != topics.SAFETY_STATE.name:
                heard.clear()
        drain(time.monotonic() + seconds)
        self.messages[topics.SAFETY_STATE.name] = safety
        for _, subscription in subscriptions.values():
            self._node.destroy_subscription(subscription)

    def _safety(self) -> list[tuple[str, str, bool]]:
        newest: dict[str, DiagnosticStatus] = {}
        for message in self.messages.get(topics.SAFETY_STATE.name, []):
            status = deserialize_message(message.data, DiagnosticStatus)
            newest[status.name] = status
        return [(name, status.message, status.level >= DiagnosticStatus.ERROR) for name, status in newest.items()]

    def _seen(self) -> tuple[list[str], list[int]]:
        return self._nodes(), [self._node.count_publishers(self._full(topic.name)) for topic in topics.ALL]

    def _nodes(self) -> list[str]:
        found = (f"{namespace.rstrip('/')}/{name}" for name, namespace in self._node.get_node_names_and_namespaces())
        return sorted(name for name in found if name != f"/{DOCTOR}")

    def _publishers(self) -> dict[str, list[Endpoint]]:
        return {
            topic.name: self._endpoints(self._node.get_publishers_info_by_topic(self._full(topic.name)))
            for topic in topics.ALL
        }

    def _full(self, name: str) -> str:
        return self._node.resolve_topic_name(name)

    def _endpoints(self, infos: Sequence[TopicEndpointInfo]) -> list[Endpoint]:
        return [
            Endpoint(_node_name(info), info.topic_type, info.qos_profile) for info in infos if info.node_name != DOCTOR
        ]

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


def _node_name(info: TopicEndpointInfo) -> str:
    if info.node_name == UNKNOWN_NODE:
        return "an unknown node"
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _in_order(state: JointState, field: str) -> list[float]:
    """Values of the arm's joints in its order, NaN for those that a message has not."""
    values = dict(zip(state.name, getattr(state, field), strict=False))
    return [values.get(joint, float("nan")) for joint in iiwa14.JOINT_NAMES]
