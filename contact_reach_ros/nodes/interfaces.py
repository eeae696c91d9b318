"""Who publishes, reads, serves and calls what: the stack's graph as it should be.

`contact-reach doctor` compares a running stack with it, and the security policies in config/security are made from it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.processes import TUNABLE, VIEWER
from contact_reach_ros.nodes.topics import Topic


@dataclass(frozen=True)
class Interface:
    """What one node may do at most; names are relative to its namespace, '~' stands for the node.

    Attributes
    ----------
    publishes, subscribes
        Topics.
    serves
        Services that it offers.
    calls
        Services of others that it uses.
    """

    publishes: frozenset[str]
    subscribes: frozenset[str]
    serves: frozenset[str]
    calls: frozenset[str] = frozenset()


STOPPABLE = ("controller", "observer", "driver")
"""Nodes with the services ~/stop and ~/reset."""

_PARAMETER_SERVICES = {
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/get_type_description",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
}
_LIFECYCLE_SERVICES = {
    "~/change_state",
    "~/get_available_states",
    "~/get_available_transitions",
    "~/get_state",
    "~/get_transition_graph",
}
_EVERY_NODE_PUBLISHES = {"/parameter_events", "/rosout"}
"""Absolute, as ROS has them."""


def _node(
    publishes: Iterable[Topic], subscribes: Iterable[Topic], calls: Iterable[str] = (), serves: Iterable[str] = ()
) -> Interface:
    return Interface(
        frozenset(_EVERY_NODE_PUBLISHES | {topic.name for topic in publishes}),
        frozenset(topic.name for topic in subscribes),
        frozenset(_PARAMETER_SERVICES | set(serves)),
        frozenset(calls),
    )


def _managed(
    publishes: Iterable[Topic], subscribes: Iterable[Topic], serves: Iterable[str] = (), calls: Iterable[str] = ()
) -> Interface:
    plain = _node([*publishes, topics.DIAGNOSTICS, topics.SETTINGS], [*subscribes, topics.CLOCK], calls)
    return Interface(
        plain.publishes | {"~/transition_event"},
        plain.subscribes,
        plain.serves | _LIFECYCLE_SERVICES | set(serves),
        plain.calls,
    )


def _replay() -> Interface:
    """What it may publish where security is on: nothing that an arm might follow."""
    harmless = [topic for topic in topics.ALL if topic not in (*ALONE, *COMMANDING)]
    plain = _node(harmless, [])
    return Interface(plain.publishes, plain.subscribes, plain.serves | {"~/pause", "~/step"})


_STOP = ("~/stop", "~/reset")

HEARD_BY_VIEWER = (
    topics.JOINT_STATES,
    topics.EXTERNAL_TORQUE,
    topics.OBSTACLES,
    topics.PLAN_MARKERS,
    topics.REFERENCE_POSE,
    topics.SIM_CONTACTS,
    topics.GOAL_POSE,
    topics.SAFETY_STATE,
    topics.DIAGNOSTICS,
)
_CALLED_BY_VIEWER = (
    *(f"{name}/{service}" for name in STOPPABLE for service in ("stop", "reset")),
    *(
        f"{name}/{service}"
        for name in TUNABLE
        for service in ("list_parameters", "describe_parameters", "get_parameters")
    ),
    *(f"bringup/{service}" for service in ("get_parameters", "set_parameters_atomically", "restart")),
)

MANAGED = {
    "driver": _managed(
        [
            topics.JOINT_STATES,
            topics.SIM_CONTACTS,
            topics.OBSTACLES,
            topics.SAFETY_STATE,
            topics.ROBOT_DESCRIPTION,
            topics.CLOCK,
        ],
        [topics.COMMANDS, topics.LOCKSTEP_HORIZON, topics.SIM_FAULTS],
        _STOP,
    ),
    "controller": _managed(
        [
            topics.COMMANDS,
            topics.SHADOW_COMMANDS,
            topics.SAFETY_STATE,
            topics.LOCKSTEP_HORIZON,
            topics.CONTROLLER_INTAKE,
        ],
        [
            topics.JOINT_STATES,
            topics.SAFETY_STATE,
            topics.REFERENCE_POSE,
            topics.REFERENCE_POSTURE,
            topics.LOCKSTEP_HORIZON,
        ],
        _STOP,
    ),
    "observer": _managed(
        [
            topics.EXTERNAL_TORQUE,
            topics.EXTERNAL_WRENCH,
            topics.SAFETY_STATE,
            topics.LOCKSTEP_HORIZON,
            topics.OBSERVER_INTAKE,
        ],
        [topics.JOINT_STATES, topics.COMMANDS],
        _STOP,
    ),
    "planner": _managed(
        [
            topics.REFERENCE_POSE,
            topics.REFERENCE_POSTURE,
            topics.PLAN_PATH,
            topics.PLAN_MARKERS,
            topics.PLAN_STATISTICS,
            topics.PLAN_SOLUTION,
            topics.LOCKSTEP_HORIZON,
            topics.PLANNER_INTAKE,
        ],
        [topics.JOINT_STATES, topics.GOAL_POSE, topics.OBSTACLES, topics.SAFETY_STATE],
    ),
    "recorder": _managed([], topics.ALL),
    VIEWER: _managed([topics.GOAL_POSE], HEARD_BY_VIEWER, calls=_CALLED_BY_VIEWER),
}
"""The lifecycle nodes."""

DOCTOR = "contact_reach_doctor"

REPLAY = "replay"

ALONE = (topics.JOINT_STATES, topics.COMMANDS, topics.REFERENCE_POSE, topics.REFERENCE_POSTURE)
"""Topics that must have a single publisher: with two of them the arm gets the commands of both in turn."""

COMMANDING = (
    topics.COMMANDS,
    topics.REFERENCE_POSE,
    topics.REFERENCE_POSTURE,
    topics.GOAL_POSE,
    topics.SIM_FAULTS,
)
"""Topics whose messages make an arm move, or its simulation go wrong."""

ACTING = ("driver", "controller", "planner")
"""Nodes that act on what they hear; the others only watch."""

INTERFACES = {
    **MANAGED,
    "bringup": _node(
        [],
        [topics.JOINT_STATES],
        [*(f"{name}/get_state" for name in sorted(MANAGED)), "controller/stop"],
        ["~/restart"],
    ),
    DOCTOR: _node(
        [],
        topics.ALL,
        [f"{name}/{service}" for name in sorted(MANAGED) for service in ("get_state", "get_parameters")],
    ),
    REPLAY: _replay(),
}
"""All nodes of the package, by name."""
