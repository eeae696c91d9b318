"""Checks of the running stack: who can hear it, its nodes, its topics, and whether the arm is stopped.

`look_around` does not disturb it: it looks at the graph, and listens for a second.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState

from contact_reach_ros.arm import Arm
from contact_reach_ros.doctor.arm import JointRecord
from contact_reach_ros.doctor.findings import Finding, Verdict, failed, graded
from contact_reach_ros.drives.settings import FRANKA, FRANKA_STATES, LBR
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.safety_state import ERROR, read_level
from contact_reach_ros.messages.topics import Qos, Topic
from contact_reach_ros.messages.values import nanoseconds, read_settings
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.discovery import reach
from contact_reach_ros.ros.graph import full_name, node_of
from contact_reach_ros.ros.interfaces import ADAPTER, ALONE, DOCTOR, MANAGED, OWNERS, VIEWER
from contact_reach_ros.ros.process import bare_node, in_namespace

NEEDED_NODES = ("controller", "observer", "planner")
"""A real robot's driver may have any name; recorder and bring-up are not needed."""

_NEEDED_TOPICS = (*ALONE, topics.SAFETY_STATE, topics.EXTERNAL_TORQUE)

_EFFORT_CONTROLLER = "effort_controller"
"""Its name without an adapter that is set otherwise."""
_DRIVE_TIMEOUT_S = 0.1
"""Recommended for a drive that has a timeout: the adapter's own time until a stop."""
ANYTHING = Qos(2000, reliable=False)
"""Matches every publisher."""
SETTLED_S = 3.5
"""A participant announces itself every three seconds; where the first answer was lost it is found no sooner."""
_MATCHING_S = 1.0

Heard = Sequence[tuple[JointState, int]]
"""Joint states, and when each arrived on the system clock, ns."""


class Endpoint(NamedTuple):
    """One publisher or subscription: full name of its node, type of its messages, what it offers or requests."""

    node: str
    type: str
    qos: QoSProfile


@dataclasses.dataclass(frozen=True)
class Graph:
    """The graph of a ROS domain.

    Attributes
    ----------
    nodes
        Full names; a name that two nodes have occurs twice.
    publishers, subscriptions
        By the stack's name of the topic.
    states
        Lifecycle state of the stack's nodes by name; empty for one that does not answer.
    safety
        The latched safety states that came: name of the node, message, and whether it is a stop.
    settings
        What the nodes report of their settings, by node.
    drive
        Joints and timeouts, s, among the parameters of a ros2_control controller that takes the commands.
    namespace
        Of the stack, such as /left; empty for the root.
    """

    nodes: Sequence[str] = ()
    publishers: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    subscriptions: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)
    safety: Sequence[tuple[str, str, bool]] = ()
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    drive: Mapping[str, Any] = field(default_factory=dict)
    namespace: str = ""

    def full(self, name: str) -> str:
        """Full name of a node of the stack."""
        return f"{self.namespace}/{name}"

    @property
    def adapter(self) -> str:
        """Kind of the adapter; empty without one."""
        return str(self.settings.get(ADAPTER, {}).get("kind", ""))

    @property
    def effort_controller(self) -> str:
        """Name of the ros2_control controller that takes the commands, where there is one."""
        name = self.settings.get(ADAPTER, {}).get(f"{self.adapter}.controller", _EFFORT_CONTROLLER)
        return str(name)

    @property
    def running(self) -> bool:
        """Whether any part of a stack is there."""
        return any(self.full(name) in self.nodes for name in MANAGED if name != VIEWER) or bool(
            self.publishers.get(topics.JOINT_STATES.name)
        )


def look_around(seconds: float, namespace: str = "/") -> tuple[Graph, Heard]:
    """Look at the stack with a node of its own; returns its graph and the joint states that came.

    Raises `ContactReachError` if ROS does not start a node.

    Parameters
    ----------
    seconds
        How long to listen, if anything is there.
    namespace
        Of the stack.
    """
    with bare_node(DOCTOR, [DOCTOR, *in_namespace(namespace)]) as node:
        client = Client(node)
        time.sleep(SETTLED_S)
        names, states = _nodes(node), {}
        for name in (name for name in MANAGED if node.resolve_service_name(name) in names):
            answer = _ask(client, f"{name}/get_state", GetState, GetState.Request())
            states[name] = answer.current_state.label if answer is not None else ""
        safety: dict[str, DiagnosticStatus] = {}
        settings: dict[str, Mapping[str, Any]] = {}
        # Franka's driver has slow states on joint_states, which its stack does not hear.
        heard: dict[str, list[tuple[JointState, int]]] = {topics.JOINT_STATES.name: [], FRANKA_STATES: []}
        inbox = client.inbox
        inbox.add(topics.SAFETY_STATE, lambda status: safety.update({status.name: status}), topics.ALL_EVENTS)
        inbox.add(
            topics.SETTINGS, lambda status: settings.update({status.name: read_settings(status)}), topics.ALL_EVENTS
        )
        for name, came in heard.items():
            take = lambda state, came=came: came.append((state, inbox.received_ns))  # noqa: E731
            inbox.add(topics.JOINT_STATES._replace(name=name), take, ANYTHING)
        # What comes before every subscription is matched is no measure of rates.
        client.spin(_MATCHING_S)
        for came in heard.values():
            came.clear()
        client.spin(seconds)
        graph = Graph(
            _nodes(node),
            {topic.name: endpoints(node.get_publishers_info_by_topic(topic.name)) for topic in topics.ALL},
            {topic.name: endpoints(node.get_subscriptions_info_by_topic(topic.name)) for topic in topics.ALL},
            states,
            [(name, status.message, read_level(status) >= ERROR) for name, status in safety.items()],
            settings,
            namespace=node.get_namespace().rstrip("/"),
        )
        if node.resolve_service_name(graph.effort_controller) in names:
            graph = dataclasses.replace(graph, drive=_parameters_of_drive(client, graph.effort_controller))
        client.close()
    return graph, heard[FRANKA_STATES if graph.adapter == FRANKA else topics.JOINT_STATES.name]


def _ask(client: Client, service: str, kind: Any, request: Any) -> Any:
    """The answer of a service; None without any."""
    try:
        return client.call(service, kind, request)
    except ContactReachError:
        return None


def _parameters_of_drive(client: Client, name: str) -> Mapping[str, Any]:
    """Joints and timeouts, s, among the parameters of a ros2_control controller; empty without an answer."""
    listed = _ask(client, f"{name}/list_parameters", ListParameters, ListParameters.Request())
    names = [] if listed is None else [name for name in listed.result.names if name == "joints" or "timeout" in name]
    answer = _ask(client, f"{name}/get_parameters", GetParameters, GetParameters.Request(names=names))
    values = [] if answer is None else map(parameter_value_to_python, answer.values)
    return dict(zip(names, values, strict=False))


def joint_record(heard: Heard, arm: Arm) -> JointRecord:
    """Joint states of an arm as arrays."""

    def column(name: str) -> Any:
        """Values of the arm's joints in its order, NaN for those that a message lacks."""
        read = [dict(zip(state.name, getattr(state, name), strict=False)) for state, _ in heard]
        return np.array([[each.get(joint, np.nan) for joint in arm.joint_names] for each in read]).reshape(-1, arm.n)

    return JointRecord(
        tuple(dict.fromkeys(tuple(state.name) for state, _ in heard)),
        np.array([nanoseconds(state.header.stamp) for state, _ in heard], dtype=np.int64),
        np.array([received_ns for _, received_ns in heard], dtype=np.int64),
        column("position"),
        column("velocity"),
        column("effort"),
    )


def _nodes(node: Node) -> list[str]:
    found = (full_name(namespace, name) for name, namespace in node.get_node_names_and_namespaces())
    return sorted(name for name in found if name != node.get_fully_qualified_name())


def endpoints(infos: Sequence[TopicEndpointInfo]) -> list[Endpoint]:
    """Those of others."""
    return [Endpoint(node_of(info), info.topic_type, info.qos_profile) for info in infos if info.node_name != DOCTOR]


def discovery_in_use() -> Finding:
    """Check who can hear nodes that are started from here."""
    (choice, line), domain = reach(os.environ), os.environ.get("ROS_DOMAIN_ID", "0")
    fix = "leave discovery at host and unset the variable, or use a network of its own or SROS 2: docs/security.md"
    return graded(f"{line}, domain {domain}", fix, warn=choice != "host")


def nodes(graph: Graph) -> Finding:
    """Check whether each node runs once and is active."""
    if not graph.running:
        found = f"no stack is running here; other nodes: {', '.join(graph.nodes) or 'none'}"
        fix = "contact-reach up, with the same ROS_DOMAIN_ID, --namespace and --discovery; "
        fix += "with a real driver: doctor --adapter KIND"
        return graded(found, fix, warn=True)
    twice = sorted(node for node, count in Counter(graph.nodes).items() if count > 1)
    if twice:
        fix = "end one of the two stacks (ros2 node list), or give each robot a ROS_DOMAIN_ID of its own"
        return failed(f"more than one node is called {', '.join(twice)}", fix)
    states = {**dict.fromkeys(NEEDED_NODES, "missing"), **graph.states}
    fixes = {
        "missing": "ros2 run contact_reach_ros {0}, or contact-reach up",
        "inactive": "ros2 lifecycle set {1} activate",
        "unconfigured": "ros2 lifecycle set {1} configure",
    }
    restart = "look into the log of {0}, end it and start it again"
    idle = [
        fixes.get(state, restart).format(node, graph.full(node)) for node, state in states.items() if state != "active"
    ]
    found = ", ".join(f"{node} is {state or 'silent'}" for node, state in states.items())
    return graded(found, "; ".join(idle), fail=bool(idle))


def safety_state(graph: Graph) -> Finding:
    """Check whether the arm is stopped, and whether it may move unwatched."""
    stopped = [who for who, _, is_stop in graph.safety if is_stop]
    found = "; ".join(f"{who}: {what}" for who, what, _ in graph.safety)
    if stopped:
        calls = "; ".join(f"ros2 service call {graph.full(who)}/reset std_srvs/srv/Trigger" for who in stopped)
        reset = "contact-reach reset" + f" --namespace {graph.namespace}" * bool(graph.namespace)
        return failed(f"stopped: {found}", f"remove the cause, then release: {reset}, or {calls}")
    if not graph.safety:
        fix = "look whether controller and observer are active, and into their logs"
        return graded("no node reports the state of the arm", fix, warn=True)
    if graph.settings.get("controller", {}).get("supervision.require_observer") is not False:
        return Finding(Verdict.PASS, found)
    fix = "start the observer, and the controller with supervision.require_observer: true"
    return graded(f"{found}; the controller requires no observer: the arm may move unwatched", fix, warn=True)


def commands_end(graph: Graph) -> Finding:
    """Check what the drive does without commands, as when the adapter, or a controller without one, has died."""
    driver = graph.settings.get("driver", {})
    if driver.get("watchdog.enabled"):
        return Finding(Verdict.PASS, "the driver's watchdog brakes the arm")
    if driver:
        fix = "set watchdog.enabled: true for the driver, unless it is to behave like a drive without a watchdog"
        return graded("the driver keeps the last torque", fix, warn=True)
    timeouts = {name: value for name, value in graph.drive.items() if isinstance(value, float)}
    off = [name for name, seconds in timeouts.items() if not seconds > 0.0]
    name = graph.effort_controller
    if off:
        fix = f"see what the arm does at such a timeout, then set {off[0]}: {_DRIVE_TIMEOUT_S:g} for {name}"
        return graded(f"{', '.join(off)} of {name} is off: the last torque stays", fix, warn=True)
    if timeouts:
        own = ", ".join(f"{each} = {seconds:g} s" for each, seconds in timeouts.items())
        return Finding(Verdict.PASS, f"{name} has {own}")
    return Finding(Verdict.PASS, "the drive offers no timeout here; docs/adapter.md says what remains")


def topic(graph: Graph, wanted: Topic) -> Finding:
    """Check publishers and subscriptions of one topic: how many, which types, and whether their QoS match."""
    publishers = graph.publishers.get(wanted.name, ())
    subscriptions = graph.subscriptions.get(wanted.name, ())
    found, fix = f"{_names(publishers) or 'nobody'} → {_names(subscriptions) or 'nobody'}", ""
    strange = [endpoint for endpoint in (*publishers, *subscriptions) if endpoint.type != wanted.type_name]
    deaf = incompatible(publishers, subscriptions)
    if strange:
        found += f"; {_names(strange)} uses {', '.join(sorted({endpoint.type for endpoint in strange}))}"
        fix = f"let {_names(strange)} use {wanted.type_name}, or another topic"
    elif wanted in ALONE and len(publishers) > 1:
        found += f": {len(publishers)} publishers, expected one"
        owners = {graph.full(name) for name in OWNERS[wanted.name]}
        rivals = [endpoint.node for endpoint in publishers if endpoint.node not in owners]
        fix = f"end {', '.join(rivals) or 'all but one'}, or remap its topic: the arm would receive all in turn"
    elif deaf:
        found += f"; {deaf}"
        fix = "let the subscription ask for less (best effort, volatile), or the publisher offer more "
        fix += "(reliable, transient local)"
    elif wanted in _NEEDED_TOPICS and not publishers and not _is_elsewhere(graph, wanted):
        fix = f"start {' or '.join(OWNERS[wanted.name])}, or remap your topic to this name"
    return Finding(Verdict.FAIL if fix else Verdict.PASS, found, fix)


def _is_elsewhere(graph: Graph, wanted: Topic) -> bool:
    """Whether the adapter's commands have another topic."""
    other = graph.adapter == LBR or f"{graph.effort_controller.lstrip('/')}/commands" != topics.COMMANDS.name
    return wanted is topics.COMMANDS and other


def incompatible(publishers: Sequence[Endpoint], subscriptions: Sequence[Endpoint]) -> str:
    """The first node that gets nothing from a publisher, with the reason; empty if there is none."""
    for publisher in publishers:
        found = [(each.node, *qos_check_compatible(publisher.qos, each.qos)) for each in subscriptions]
        # Several subscriptions of a node complement each other.
        hear = {node for node, compatibility, _ in found if compatibility != QoSCompatibility.ERROR}
        for node, _, reason in found:
            if node not in hear:
                return f"{node} gets nothing from {publisher.node}: {reason.strip().rstrip(';')}"
    return ""


def _names(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(endpoint.node.removeprefix("/") for endpoint in endpoints)
