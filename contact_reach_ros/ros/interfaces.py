"""Topics and services of every node: the stack's graph as it should be.

`contact-reach doctor` compares a running stack with it; the security policies in config/security are made from it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from contact_reach_ros.control.supervisor import RESET_ORDER
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic


@dataclass(frozen=True)
class Interface:
    """Permitted topics and services of one node; names are relative to its namespace, '~' stands for the node.

    Attributes
    ----------
    publishes, subscribes
        Topics.
    serves
        Services offered.
    calls
        Services of other nodes used.
    """

    publishes: frozenset[str]
    subscribes: frozenset[str]
    serves: frozenset[str]
    calls: frozenset[str] = frozenset()


OBSERVER, ADAPTER, RECORDER, VIEWER, DEMO, REPLAY = "observer", "adapter", "recorder", "viewer", "demo", "replay"
DOCTOR = "contact_reach_doctor"
OPERATOR = "operator"
"""The node of contact-reach goto, home, identify, speed, stop and reset."""

STOPPABLE = RESET_ORDER[::-1]
"""Nodes with the services ~/stop and ~/reset."""

_MANAGED_SERVICES = [
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
    "~/change_state",
    "~/get_available_states",
    "~/get_available_transitions",
    "~/get_state",
    "~/get_transition_graph",
]
_STOP = {"~/stop", "~/reset"}
_STOP_AND_RESET = [f"{name}/{service}" for name in STOPPABLE for service in ("stop", "reset")]
_EVERY_NODE_PUBLISHES = {"/parameter_events", "/rosout"}
"""Absolute, as ROS has them."""

_REFERENCES = [topics.REFERENCE_POSE, topics.REFERENCE_POSTURE]
_PLANS = [topics.PLAN_PATH, topics.PLAN_MARKERS, topics.PLAN_STATISTICS, topics.PLAN_REQUEST]


def _node(
    publishes: Iterable[Topic], subscribes: Iterable[Topic], serves: Iterable[str] = (), calls: Iterable[str] = ()
) -> Interface:
    return Interface(
        frozenset({*_EVERY_NODE_PUBLISHES, *(topic.name for topic in publishes)}),
        frozenset(topic.name for topic in subscribes),
        frozenset({"~/get_type_description", *serves}),
        frozenset(calls),
    )


def _managed(
    publishes: Iterable[Topic], subscribes: Iterable[Topic], serves: Iterable[str] = (), calls: Iterable[str] = ()
) -> Interface:
    """A lifecycle node; all others have no parameters that could be asked for."""
    said = [*publishes, topics.DIAGNOSTICS, topics.SETTINGS]
    node = _node(said, [*subscribes, topics.CLOCK], [*_MANAGED_SERVICES, *serves], calls)
    return replace(node, publishes=node.publishes | {"~/transition_event"})


_SIMULATED = [topics.JOINT_STATES, topics.SIM_CONTACTS, topics.OBSTACLES, topics.ROBOT_DESCRIPTION, topics.CLOCK]
_TORQUES = [topics.COMMANDS, topics.ADAPTER_COMMANDS, topics.SHADOW_COMMANDS]
_EXTERNAL = [topics.EXTERNAL_TORQUE, topics.EXTERNAL_WRENCH]
_REPORTS = [topics.SAFETY_STATE, topics.DIAGNOSTICS]
_PACE = [topics.JOINT_STATES, topics.LOCKSTEP_HORIZON]
"""Heard by nodes that follow the joint states; in simulated time they promise on the second as well."""

HEARD_BY_VIEWER = (
    topics.JOINT_STATES,
    topics.EXTERNAL_TORQUE,
    topics.OBSTACLES,
    topics.PLAN_MARKERS,
    topics.SIM_CONTACTS,
    topics.PLAN_STATISTICS,
    topics.SAFETY_STATE,
)

MANAGED = {
    "driver": _managed(
        [*_SIMULATED, topics.SAFETY_STATE], [topics.COMMANDS, topics.LOCKSTEP_HORIZON, topics.GOAL_STATE], _STOP
    ),
    "controller": _managed(
        [*_TORQUES, topics.SAFETY_STATE, topics.CONTROLLER_INTAKE, topics.LOCKSTEP_HORIZON],
        [*_PACE, *_REFERENCES, topics.SAFETY_STATE, topics.SETTINGS],
        _STOP,
    ),
    "observer": _managed(
        [*_EXTERNAL, topics.SAFETY_STATE, topics.OBSERVER_INTAKE, topics.LOCKSTEP_HORIZON],
        _PACE,
        _STOP,
    ),
    "planner": _managed(
        [*_REFERENCES, *_PLANS, topics.GOAL_STATE, topics.LOCKSTEP_HORIZON],
        [*_PACE, topics.GOAL_POSE, topics.OBSTACLES, topics.SAFETY_STATE],
    ),
    ADAPTER: _managed(
        [topics.COMMANDS, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON],
        [*_PACE, topics.ADAPTER_COMMANDS, topics.SETTINGS],
        _STOP,
        [
            "effort_controller/get_parameters",
            *(f"controller_manager/{service}" for service in ("list_controllers", "switch_controller")),
        ],
    ),
    RECORDER: _managed([topics.LOCKSTEP_HORIZON], topics.ALL),
    VIEWER: _managed([topics.GOAL_POSE], HEARD_BY_VIEWER, calls=_STOP_AND_RESET),
}
"""The lifecycle nodes."""

ALONE = (topics.JOINT_STATES, topics.COMMANDS, *_REFERENCES)
"""Topics that must have a single publisher: with two, the arm receives the commands of both in turn."""

INTERFACES = {
    **MANAGED,
    "bringup": _node([], [topics.JOINT_STATES], [], [*(f"{name}/get_state" for name in MANAGED), "controller/stop"]),
    DOCTOR: _node(
        [],
        topics.ALL,
        calls=[
            *(f"{name}/get_state" for name in MANAGED),
            *(f"effort_controller/{service}" for service in ("get_parameters", "list_parameters")),
        ],
    ),
    OPERATOR: _node(
        [topics.GOAL_POSE],
        [topics.GOAL_STATE, *_REPORTS, topics.SETTINGS, topics.JOINT_STATES],
        calls=[*_STOP_AND_RESET, "planner/set_parameters_atomically"],
    ),
    REPLAY: _node([topic._replace(name=f"{REPLAY}/{topic.name}") for topic in topics.ALL], []),
}
"""All nodes of the package, by name."""
