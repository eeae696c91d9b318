"""Checks of the running stack: who can hear it, its nodes, its topics, and whether the arm is stopped."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.control.agreement import disagreement
from contact_reach_ros.doctor.findings import Finding, check, failed, passed, warned
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.discovery import OLD_SWITCH, RANGE, reach
from contact_reach_ros.ros.interfaces import ALONE, INTERFACES, MANAGED, RECORDER, VIEWER
from contact_reach_ros.timing import PERIOD

_START = "contact-reach up"

_MEASURED_WITH = "rmw_fastrtps_cpp"

_CONTROLLER, _PLANNER = "controller", "planner"

_NEEDED_NODES = (_CONTROLLER, "observer", _PLANNER)
"""A real robot's driver may have any name; recorder and bring-up are not needed."""

_NEEDED_TOPICS = (*ALONE, topics.SAFETY_STATE, topics.EXTERNAL_TORQUE)


class Endpoint(NamedTuple):
    """One publisher or subscription: full name of its node, type of its messages, what it offers or requests."""

    node: str
    type: str
    qos: QoSProfile


@dataclass(frozen=True)
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
    simulated_time
        Parameter use_sim_time by node, where it is known.
    safety
        The latched safety states that came: name of the node, message, and whether it is a stop.
    requires_observer
        Whether the controller starts only an arm that an observer vouches for.
    settings
        What the nodes report of their settings, by node.
    """

    nodes: Sequence[str] = ()
    publishers: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    subscriptions: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)
    simulated_time: Mapping[str, bool] = field(default_factory=dict)
    safety: Sequence[tuple[str, str, bool]] = ()
    requires_observer: bool = True
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def nominal_rate(self) -> float:
        """Of joint states, Hz: what the controller reports, or else the default."""
        rate = self.settings.get(_CONTROLLER, {}).get("state_rate")
        return rate if isinstance(rate, float) else 1.0 / PERIOD

    @property
    def running(self) -> bool:
        """Whether any part of a stack is there."""
        return any(f"/{name}" in self.nodes for name in MANAGED if name != VIEWER) or bool(
            self.publishers.get(topics.JOINT_STATES.name)
        )


@check("discovery")
def discovery_in_use() -> Finding:
    """Check who can hear nodes that are started from here, and by which middleware."""
    heard, middleware = reach(os.environ), get_rmw_implementation_identifier()
    who = f"; {middleware}, domain {os.environ.get('ROS_DOMAIN_ID', '0')}"
    if heard.choice == "subnet":
        found = f"open to everybody on the subnet ({heard.why})"
        fix = (
            f"leave discovery at host and unset {RANGE}; else use a network of its own or SROS 2, see docs/security.md"
        )
    elif not heard.choice:
        found = f"set by {heard.why}"
        fix = "see that the file keeps to 127.0.0.1, or unset the variable to use the package's own profile"
    elif heard.shared_memory:
        found = f"this host only ({heard.why}), also by shared memory, in which publishers were seen to stall"
        variable = OLD_SWITCH if os.environ.get(OLD_SWITCH) == "1" else RANGE
        fix = f"unset {variable}: the package keeps to this host by itself"
    elif middleware != _MEASURED_WITH:
        found = f"this host only ({heard.why}), without config/fastdds.xml, which only Fast DDS reads"
        fix = f"export RMW_IMPLEMENTATION={_MEASURED_WITH}, which this package is measured with"
    else:
        return passed(f"this host only ({heard.why}){who}", choice=heard.choice)
    return warned(found + who, fix, choice=heard.choice)


@check("nodes")
def nodes(graph: Graph) -> Finding:
    """Check which nodes run, and whether any name occurs twice."""
    if not graph.running:
        others = f"; other nodes: {', '.join(sorted(graph.nodes))}" if graph.nodes else ""
        fix = (
            f"start it: {_START} (with a real driver: {_START} --no-driver). If it runs, use the same "
            "ROS_DOMAIN_ID, RMW_IMPLEMENTATION and discovery (--discovery) here as there"
        )
        return warned(f"no stack is running here{others}", fix)
    twice = sorted(node for node, count in Counter(graph.nodes).items() if count > 1)
    if twice:
        fix = "end one of the two stacks (ros2 node list), or give each robot a ROS_DOMAIN_ID of its own"
        return failed(f"more than one node is called {', '.join(twice)}", fix)
    missing = [node for node in _NEEDED_NODES if f"/{node}" not in graph.nodes]
    found = ", ".join(sorted(node.removeprefix("/") for node in graph.nodes))
    if missing:
        starts = "; ".join(f"ros2 run contact_reach_ros {node}" for node in missing)
        return failed(f"not running: {', '.join(missing)}; found {found}", f"start bring-up ({_START}), or {starts}")
    return passed(found, nodes=sorted(graph.nodes))


@check("lifecycle")
def lifecycle(graph: Graph) -> Finding:
    """Check whether the lifecycle nodes are active."""
    silent = [node for node, state in graph.states.items() if not state]
    if silent:
        fix = "look into its log; a process that is frozen or stuck has to be ended and started again"
        return failed(f"no answer from {', '.join(silent)}", fix)
    idle = {node: state for node, state in graph.states.items() if state != "active"}
    if idle:
        steps = "; ".join(
            f"ros2 lifecycle set /{node} {'activate' if state == 'inactive' else 'configure'}"
            for node, state in idle.items()
        )
        return failed(", ".join(f"{node} is {state}" for node, state in idle.items()), steps)
    return passed(f"{', '.join(graph.states) or 'no lifecycle node of this package'} active")


@check("time source")
def time_source(graph: Graph) -> Finding:
    """Check whether all nodes use the same time, and somebody publishes it if it is simulated."""
    simulated = [node for node, value in graph.simulated_time.items() if value]
    # They use the stamps of what they show or record, and the times of its reception.
    real = [node for node, value in graph.simulated_time.items() if not value and node not in (VIEWER, RECORDER)]
    clocks = [endpoint.node for endpoint in graph.publishers.get(topics.CLOCK.name, ())]
    fix = "start all nodes with the same use_sim_time; bring-up does (parameter lockstep)"
    if simulated and not clocks:
        return failed(f"{', '.join(simulated)}: use_sim_time, and nobody publishes /clock", fix)
    # The driver of the lockstep is the clock.
    behind = [node for node in real if clocks and f"/{node}" not in clocks]
    if behind:
        found = f"{', '.join(clocks)} publishes /clock, and {', '.join(behind)} does not use it (use_sim_time is false)"
        return failed(found, fix)
    return passed(f"simulated, from {', '.join(clocks)}" if clocks else "this machine's clock")


@check("gains")
def gains(graph: Graph) -> Finding:
    """Check whether planner and controller report the same arm, rate and gains."""
    missing = [node for node in (_CONTROLLER, _PLANNER) if node not in graph.settings]
    if missing:
        fix = "look whether they are active: a node reports its settings when it is activated"
        return warned(f"not compared: {' and '.join(missing)} did not report settings", fix)
    differs = disagreement(graph.settings[_CONTROLLER], graph.settings[_PLANNER])
    if differs:
        fix = "give both the same values in the parameter file, and start them again with it"
        return failed(f"{differs}: the controller refuses every plan, the arm does not follow a goal", fix)
    return passed("planner and controller have the same arm, rate and gains")


@check("safety state")
def safety_state(graph: Graph) -> Finding:
    """Check whether the arm is stopped, and whether it may move unwatched."""
    stops = {who: what for who, what, stopped in graph.safety if stopped}
    if stops:
        calls = "; ".join(f"ros2 service call /{who}/reset std_srvs/srv/Trigger" for who in stops)
        found = "; ".join(f"{who}: {what}" for who, what in stops.items())
        return failed(f"stopped: {found}", f"remove the cause, then release: contact-reach reset, or {calls}")
    if not graph.safety:
        fix = "look whether controller and observer are active, and into their logs"
        return warned("no node reports the state of the arm", fix)
    found = ", ".join(f"{who}: {what}" for who, what, _ in graph.safety)
    if not graph.requires_observer:
        fix = "start the observer, and the controller with supervision.require_observer: true"
        return warned(f"{found}; the controller requires no observer, so that the arm may move unwatched", fix)
    return passed(found)


@check(lambda graph, wanted: wanted.name)
def topic(graph: Graph, wanted: Topic) -> Finding:
    """Check publishers and subscriptions of one topic: how many, which types, and whether their QoS match."""
    publishers = graph.publishers.get(wanted.name, ())
    subscriptions = graph.subscriptions.get(wanted.name, ())
    problem, fix = (
        _wrong_type(wanted, [*publishers, *subscriptions])
        or _second_publisher(wanted, publishers)
        or _incompatible_qos(publishers, subscriptions)
        or _nobody(wanted, publishers)
        or ("", "")
    )
    found = f"{_names(publishers) or 'nobody'} → {_names(subscriptions) or 'nobody'}"
    values = {
        "type": wanted.type_name,
        "publishers": [endpoint.node for endpoint in publishers],
        "subscriptions": [endpoint.node for endpoint in subscriptions],
    }
    return failed(f"{found}{problem}", fix, **values) if fix else passed(found, **values)


def _wrong_type(wanted: Topic, endpoints: Sequence[Endpoint]) -> tuple[str, str] | None:
    strange = [endpoint for endpoint in endpoints if endpoint.type != wanted.type_name]
    if not strange:
        return None
    types = ", ".join(sorted({endpoint.type for endpoint in strange}))
    return f"; {_names(strange)} uses {types}", f"let {_names(strange)} use {wanted.type_name}, or another topic"


def _second_publisher(wanted: Topic, publishers: Sequence[Endpoint]) -> tuple[str, str] | None:
    if wanted not in ALONE or len(publishers) < 2:
        return None
    owners = [name for name, interface in INTERFACES.items() if wanted.name in interface.publishes]
    strangers = [endpoint.node for endpoint in publishers if endpoint.node.removeprefix("/") not in owners]
    who = ", ".join(strangers) or "all but one of them"
    fix = f"end {who}, or remap what it publishes: the arm would receive the messages of all in turn"
    return f": {len(publishers)} publishers, expected one", fix


def _incompatible_qos(publishers: Sequence[Endpoint], subscriptions: Sequence[Endpoint]) -> tuple[str, str] | None:
    for publisher in publishers:
        for subscription in subscriptions:
            compatibility, reason = qos_check_compatible(publisher.qos, subscription.qos)
            if compatibility == QoSCompatibility.ERROR:
                fix = (
                    f"let {subscription.node} ask for less (best effort, volatile), "
                    f"or {publisher.node} offer more (reliable, transient local)"
                )
                return f"; {subscription.node} gets nothing from {publisher.node}: {reason.strip().rstrip(';')}", fix
    return None


def _nobody(wanted: Topic, publishers: Sequence[Endpoint]) -> tuple[str, str] | None:
    if wanted not in _NEEDED_TOPICS or publishers:
        return None
    owners = [name for name, interface in MANAGED.items() if wanted.name in interface.publishes]
    return "", f"start {' or '.join(owners)} (ros2 run contact_reach_ros {owners[0]}), or remap your topic to this name"


def _names(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(endpoint.node.removeprefix("/") for endpoint in endpoints)
