"""Whether the graph of a running stack is what it should be: nodes, publishers, types, quality of service."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from contact_reach_ros.doctor.findings import Finding, failed, passed, warned
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.interfaces import ALONE, INTERFACES, MANAGED
from contact_reach_ros.nodes.processes import VIEWER
from contact_reach_ros.nodes.topics import Topic

START = "ros2 run contact_reach_ros bringup"

_NEEDED_NODES = ("controller", "observer", "planner")
"""A real robot's driver may have any name; recorder and bring-up are not needed."""

_NEEDED_TOPICS = (*ALONE, topics.SAFETY_STATE, topics.EXTERNAL_TORQUE)


class Endpoint(NamedTuple):
    """One publisher or subscription: full name of its node, type of its messages, what it offers or asks for."""

    node: str
    type: str
    qos: QoSProfile


@dataclass(frozen=True)
class Graph:
    """What was found in a ROS domain.

    Attributes
    ----------
    nodes
        Full names; a name that two nodes have is there twice.
    publishers, subscriptions
        By the stack's name of the topic.
    states
        Lifecycle state of the stack's nodes by name; empty for one that does not answer.
    simulated_time
        Parameter use_sim_time by node, where it was told.
    safety
        The latched safety states that came: who says it, what, and whether it is a stop.
    """

    nodes: Sequence[str] = ()
    publishers: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    subscriptions: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)
    simulated_time: Mapping[str, bool] = field(default_factory=dict)
    safety: Sequence[tuple[str, str, bool]] = ()

    @property
    def running(self) -> bool:
        """Whether there is anything of a stack."""
        return any(f"/{name}" in self.nodes for name in MANAGED if name != VIEWER) or bool(
            self.publishers.get(topics.JOINT_STATES.name)
        )


def type_name(topic: Topic) -> str:
    """Type of a topic as ROS writes it, such as sensor_msgs/msg/JointState."""
    package, kind, _ = topic.type.__module__.split(".")
    return f"{package}/{kind}/{topic.type.__name__}"


def nodes(graph: Graph) -> Finding:
    """Which nodes run, and whether any name is there twice."""
    name = "nodes"
    if not graph.running:
        others = f"; other nodes: {', '.join(sorted(graph.nodes))}" if graph.nodes else ""
        fix = (
            f"start it: {START} (with a real driver: --ros-args -p driver:=false). If it runs, use the same "
            "ROS_DOMAIN_ID, RMW_IMPLEMENTATION and discovery (--discovery) here as there"
        )
        return warned(name, f"no stack is running here{others}", fix)
    twice = sorted(node for node, count in Counter(graph.nodes).items() if count > 1)
    if twice:
        fix = "end one of the two stacks (ros2 node list), or give each robot a ROS_DOMAIN_ID of its own"
        return failed(name, f"more than one node is called {', '.join(twice)}", fix)
    missing = [node for node in _NEEDED_NODES if f"/{node}" not in graph.nodes]
    found = ", ".join(sorted(node.removeprefix("/") for node in graph.nodes))
    if missing:
        starts = "; ".join(f"ros2 run contact_reach_ros {node}" for node in missing)
        return failed(
            name, f"not running: {', '.join(missing)}; found {found}", f"start bring-up ({START}), or {starts}"
        )
    return passed(name, found, nodes=sorted(graph.nodes))


def lifecycle(graph: Graph) -> Finding:
    """Whether the lifecycle nodes are active."""
    name = "lifecycle"
    silent = [node for node, state in graph.states.items() if not state]
    if silent:
        fix = "look into its log; a process that is frozen or stuck has to be ended and started again"
        return failed(name, f"no answer from {', '.join(silent)}", fix)
    idle = {node: state for node, state in graph.states.items() if state != "active"}
    if idle:
        steps = "; ".join(
            f"ros2 lifecycle set /{node} {'activate' if state == 'inactive' else 'configure'}"
            for node, state in idle.items()
        )
        return failed(name, ", ".join(f"{node} is {state}" for node, state in idle.items()), steps)
    return passed(name, f"{', '.join(graph.states) or 'no lifecycle node of this package'} active")


def time_source(graph: Graph) -> Finding:
    """Whether all nodes use the same time, and somebody publishes it if it is simulated."""
    name = "time source"
    simulated = [node for node, value in graph.simulated_time.items() if value]
    # The viewer goes by the stamps of what it shows.
    real = [node for node, value in graph.simulated_time.items() if not value and node != VIEWER]
    clocks = [endpoint.node for endpoint in graph.publishers.get(topics.CLOCK.name, ())]
    fix = "start all nodes with the same use_sim_time; bring-up does (parameter lockstep)"
    if simulated and not clocks:
        return failed(name, f"{', '.join(simulated)}: use_sim_time, and nobody publishes /clock", fix)
    # The driver of the lockstep is the clock.
    behind = [node for node in real if clocks and f"/{node}" not in clocks]
    if behind:
        found = f"{', '.join(clocks)} publishes /clock, and {', '.join(behind)} does not use it (use_sim_time is false)"
        return failed(name, found, fix)
    return passed(name, f"simulated, from {', '.join(clocks)}" if clocks else "this machine's clock")


def safety_state(graph: Graph) -> Finding:
    """Whether the arm is stopped."""
    name = "safety state"
    stops = [f"{who}: {what}" for who, what, stopped in graph.safety if stopped]
    if stops:
        calls = "; ".join(
            f"ros2 service call /{who}/reset std_srvs/srv/Trigger" for who, _, stopped in graph.safety if stopped
        )
        return failed(name, f"stopped: {'; '.join(stops)}", f"remove the cause, then release: {calls}")
    if not graph.safety:
        fix = "look whether controller and observer are active, and into their logs"
        return warned(name, "nobody says what state the arm is in", fix)
    return passed(name, ", ".join(f"{who}: {what}" for who, what, _ in graph.safety))


def topic(graph: Graph, wanted: Topic) -> Finding:
    """Publishers and subscriptions of one topic: how many, which types, and whether their QoS match."""
    publishers = graph.publishers.get(wanted.name, ())
    subscriptions = graph.subscriptions.get(wanted.name, ())
    found = f"{_names(publishers) or 'nobody'} → {_names(subscriptions) or 'nobody'}"
    values: dict[str, Any] = {
        "type": type_name(wanted),
        "publishers": [endpoint.node for endpoint in publishers],
        "subscriptions": [endpoint.node for endpoint in subscriptions],
    }
    strange = [endpoint for endpoint in (*publishers, *subscriptions) if endpoint.type != type_name(wanted)]
    if strange:
        fix = f"let {_names(strange)} use {type_name(wanted)}, or another topic"
        types = ", ".join(sorted({endpoint.type for endpoint in strange}))
        return failed(wanted.name, f"{found}; {_names(strange)} uses {types}", fix, **values)
    if wanted in ALONE and len(publishers) > 1:
        owners = [name for name, interface in INTERFACES.items() if wanted.name in interface.publishes]
        strangers = [endpoint.node for endpoint in publishers if endpoint.node.removeprefix("/") not in owners]
        who = ", ".join(strangers) or "all but one of them"
        fix = f"end {who}, or remap what it publishes: the arm would get the messages of all in turn"
        return failed(wanted.name, f"{len(publishers)} publishers: {found}", fix, **values)
    for publisher in publishers:
        for subscription in subscriptions:
            compatibility, reason = qos_check_compatible(publisher.qos, subscription.qos)
            if compatibility == QoSCompatibility.ERROR:
                fix = (
                    f"let {subscription.node} ask for less (best effort, volatile), "
                    f"or {publisher.node} offer more (reliable, transient local)"
                )
                reason = reason.strip().rstrip(";")
                words = f"{subscription.node} gets nothing from {publisher.node}: {reason}"
                return failed(wanted.name, f"{found}; {words}", fix, **values)
    if wanted in _NEEDED_TOPICS and not publishers:
        owners = [name for name, interface in MANAGED.items() if wanted.name in interface.publishes]
        fix = f"start {' or '.join(owners)} (ros2 run contact_reach_ros {owners[0]}), or remap your topic to this name"
        return failed(wanted.name, found, fix, **values)
    return passed(wanted.name, found, **values)


def _names(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(endpoint.node.removeprefix("/") for endpoint in endpoints)
