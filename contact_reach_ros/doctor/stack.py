"""Checks of the running stack: who can hear it, its nodes, its topics, and whether the arm is stopped."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from contact_reach_ros.doctor.findings import Finding, Verdict, failed, graded
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.discovery import reach
from contact_reach_ros.ros.interfaces import ALONE, INTERFACES, MANAGED, VIEWER
from contact_reach_ros.timing import PERIOD

_NEEDED_NODES = ("controller", "observer", "planner")
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
    safety
        The latched safety states that came: name of the node, message, and whether it is a stop.
    requires_observer
        Whether the controller starts an arm only while an observer watches it.
    settings
        What the nodes report of their settings, by node.
    command_order
        Parameter `joints` of a ros2_control controller that takes the commands; None without one.
    """

    nodes: Sequence[str] = ()
    publishers: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    subscriptions: Mapping[str, Sequence[Endpoint]] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)
    safety: Sequence[tuple[str, str, bool]] = ()
    requires_observer: bool = True
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    command_order: Sequence[str] | None = None

    @property
    def nominal_rate(self) -> float:
        """Of joint states, Hz: what the controller reports, or else the default."""
        rate = self.settings.get("controller", {}).get("state_rate")
        return rate if isinstance(rate, float) else 1.0 / PERIOD

    @property
    def running(self) -> bool:
        """Whether any part of a stack is there."""
        return any(f"/{name}" in self.nodes for name in MANAGED if name != VIEWER) or bool(
            self.publishers.get(topics.JOINT_STATES.name)
        )


def discovery_in_use() -> Finding:
    """Check who can hear nodes that are started from here."""
    heard, domain = reach(os.environ), os.environ.get("ROS_DOMAIN_ID", "0")
    fix = "leave discovery at host and unset the variable, or use a network of its own or SROS 2: docs/security.md"
    return graded(f"{heard.text}, domain {domain}", fix, warn=heard.choice != "host")


def nodes(graph: Graph) -> Finding:
    """Check whether each node runs once and is active."""
    if not graph.running:
        found = f"no stack is running here; other nodes: {', '.join(graph.nodes) or 'none'}"
        fix = "contact-reach up (with a real driver: --no-driver), with the same ROS_DOMAIN_ID and --discovery as here"
        return graded(found, fix, warn=True)
    twice = sorted(node for node, count in Counter(graph.nodes).items() if count > 1)
    if twice:
        fix = "end one of the two stacks (ros2 node list), or give each robot a ROS_DOMAIN_ID of its own"
        return failed(f"more than one node is called {', '.join(twice)}", fix)
    states = {**dict.fromkeys(_NEEDED_NODES, "missing"), **graph.states}
    fixes = {
        "missing": "ros2 run contact_reach_ros {0}, or contact-reach up",
        "inactive": "ros2 lifecycle set /{0} activate",
        "unconfigured": "ros2 lifecycle set /{0} configure",
    }
    restart = "look into the log of {0}, end it and start it again"
    idle = [fixes.get(state, restart).format(node) for node, state in states.items() if state != "active"]
    found = ", ".join(f"{node} is {state or 'silent'}" for node, state in states.items())
    return graded(found, "; ".join(idle), fail=bool(idle))


def safety_state(graph: Graph) -> Finding:
    """Check whether the arm is stopped, and whether it may move unwatched."""
    stopped = [who for who, _, is_stop in graph.safety if is_stop]
    found = "; ".join(f"{who}: {what}" for who, what, _ in graph.safety)
    if stopped:
        calls = "; ".join(f"ros2 service call /{who}/reset std_srvs/srv/Trigger" for who in stopped)
        return failed(f"stopped: {found}", f"remove the cause, then release: contact-reach reset, or {calls}")
    if not graph.safety:
        fix = "look whether controller and observer are active, and into their logs"
        return graded("no node reports the state of the arm", fix, warn=True)
    unwatched = "" if graph.requires_observer else "; the controller requires no observer: the arm may move unwatched"
    fix = "start the observer, and the controller with supervision.require_observer: true"
    return graded(found + unwatched, fix, warn=bool(unwatched))


def topic(graph: Graph, wanted: Topic) -> Finding:
    """Check publishers and subscriptions of one topic: how many, which types, and whether their QoS match."""
    publishers = graph.publishers.get(wanted.name, ())
    subscriptions = graph.subscriptions.get(wanted.name, ())
    found, fix = f"{_names(publishers) or 'nobody'} → {_names(subscriptions) or 'nobody'}", ""
    strange = [endpoint for endpoint in (*publishers, *subscriptions) if endpoint.type != wanted.type_name]
    deaf = _incompatible(publishers, subscriptions)
    if strange:
        found += f"; {_names(strange)} uses {', '.join(sorted({endpoint.type for endpoint in strange}))}"
        fix = f"let {_names(strange)} use {wanted.type_name}, or another topic"
    elif wanted in ALONE and len(publishers) > 1:
        found += f": {len(publishers)} publishers, expected one"
        owners = [name for name, interface in INTERFACES.items() if wanted.name in interface.publishes]
        rivals = [endpoint.node for endpoint in publishers if endpoint.node.removeprefix("/") not in owners]
        fix = f"end {', '.join(rivals) or 'all but one'}, or remap its topic: the arm would receive all in turn"
    elif deaf:
        found += f"; {deaf}"
        fix = "let the subscription ask for less (best effort, volatile), or the publisher offer more "
        fix += "(reliable, transient local)"
    elif wanted in _NEEDED_TOPICS and not publishers:
        owners = [name for name, interface in MANAGED.items() if wanted.name in interface.publishes]
        fix = f"start {' or '.join(owners)}, or remap your topic to this name"
    return Finding(Verdict.FAIL if fix else Verdict.PASS, found, fix)


def _incompatible(publishers: Sequence[Endpoint], subscriptions: Sequence[Endpoint]) -> str:
    """The first subscription that gets nothing from a publisher, with the reason; empty if there is none."""
    for publisher in publishers:
        for subscription in subscriptions:
            compatibility, reason = qos_check_compatible(publisher.qos, subscription.qos)
            if compatibility == QoSCompatibility.ERROR:
                return f"{subscription.node} gets nothing from {publisher.node}: {reason.strip().rstrip(';')}"
    return ""


def _names(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(endpoint.node.removeprefix("/") for endpoint in endpoints)
