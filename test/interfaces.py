"""Topics and services of every node: the stack's graph as it should be, which the security policies are made from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from contact_reach_ros.drives.franka import REFLEX_SERVICE
from contact_reach_ros.drives.settings import FRANKA_STATES
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.topics import Topic
from contact_reach_ros.ros.interfaces import (
    ADAPTER,
    CONTROLLER,
    DOCTOR,
    DRIVER,
    MANAGED,
    OBSERVER,
    OPERATOR,
    PLANNER,
    RECORDER,
    REPLAY,
    STOPPABLE,
    VIEWER,
)


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

HEARD_BY_VIEWER = (
    topics.JOINT_STATES,
    topics.EXTERNAL_TORQUE,
    topics.OBSTACLES,
    topics.PLAN_MARKERS,
    topics.SIM_CONTACTS,
    topics.PLAN_STATISTICS,
    topics.SAFETY_STATE,
)

_REFERENCES = [topics.REFERENCE_POSE, topics.REFERENCE_POSTURE]


def _topics(*published: Topic) -> frozenset[str]:
    return frozenset(topic.name for topic in (*published, topics.DIAGNOSTICS, topics.SETTINGS))


PUBLISHES = {
    DRIVER: _topics(
        topics.JOINT_STATES,
        topics.SIM_CONTACTS,
        topics.OBSTACLES,
        topics.CLOCK,
        topics.SAFETY_STATE,
    ),
    CONTROLLER: _topics(
        topics.COMMANDS,
        topics.ADAPTER_COMMANDS,
        topics.SHADOW_COMMANDS,
        topics.SAFETY_STATE,
        topics.CONTROLLER_INTAKE,
        topics.LOCKSTEP_HORIZON,
    ),
    OBSERVER: _topics(
        topics.EXTERNAL_TORQUE,
        topics.EXTERNAL_WRENCH,
        topics.SAFETY_STATE,
        topics.OBSERVER_INTAKE,
        topics.LOCKSTEP_HORIZON,
    ),
    PLANNER: _topics(
        *_REFERENCES,
        topics.PLAN_PATH,
        topics.PLAN_MARKERS,
        topics.PLAN_STATISTICS,
        topics.PLAN_REQUEST,
        topics.GOAL_STATE,
        topics.ROBOT_DESCRIPTION,
        topics.LOCKSTEP_HORIZON,
    ),
    ADAPTER: _topics(topics.COMMANDS, topics.SAFETY_STATE, topics.LOCKSTEP_HORIZON),
    RECORDER: _topics(topics.LOCKSTEP_HORIZON),
    VIEWER: _topics(topics.GOAL_POSE),
}
"""Topics that each of the lifecycle nodes may publish, by its name."""

_OF_KUKA = frozenset({"lbr/state", "lbr/robot_description"})
"""Heard from KUKA's driver, with the default of `lbr.driver`."""
_PACE = [topics.JOINT_STATES, topics.LOCKSTEP_HORIZON]
"""Heard by nodes that follow the joint states; in simulated time they promise on the second as well."""


def _node(
    publishes: Iterable[str], subscribes: Iterable[Topic], serves: Iterable[str] = (), calls: Iterable[str] = ()
) -> Interface:
    heard = frozenset(topic.name for topic in subscribes)
    # Franka's driver has another name for the joint states, which all nodes hear then.
    return Interface(
        frozenset({*_EVERY_NODE_PUBLISHES, *publishes}),
        heard | ({FRANKA_STATES} if topics.JOINT_STATES.name in heard else set()),
        frozenset({"~/get_type_description", *serves}),
        frozenset(calls),
    )


def _managed(
    name: str, subscribes: Iterable[Topic], serves: Iterable[str] = (), calls: Iterable[str] = ()
) -> Interface:
    """A lifecycle node; all others have no parameters that could be asked for."""
    node = _node(PUBLISHES[name], [*subscribes, topics.CLOCK], [*_MANAGED_SERVICES, *serves], calls)
    return replace(node, publishes=node.publishes | {"~/transition_event"})


_RECORDER = _managed(RECORDER, topics.ALL)
_ADAPTER = _managed(
    ADAPTER,
    [*_PACE, topics.ADAPTER_COMMANDS, topics.SETTINGS],
    _STOP,
    [
        "effort_controller/get_parameters",
        *(f"controller_manager/{service}" for service in ("list_controllers", "switch_controller")),
        "lbr/controller_manager/set_hardware_component_state",
        REFLEX_SERVICE,
    ],
)
_DOCTOR = _node(
    [],
    topics.ALL,
    calls=[
        *(f"{name}/get_state" for name in MANAGED),
        *(f"effort_controller/{service}" for service in ("get_parameters", "list_parameters")),
        "controller_manager/list_controllers",
    ],
)
_LIFECYCLE = (
    _managed("driver", [topics.COMMANDS, topics.LOCKSTEP_HORIZON, topics.GOAL_STATE], _STOP),
    _managed("controller", [*_PACE, *_REFERENCES, topics.SAFETY_STATE, topics.SETTINGS], _STOP),
    _managed("observer", _PACE, _STOP),
    _managed("planner", [*_PACE, topics.GOAL_POSE, topics.OBSTACLES, topics.SAFETY_STATE]),
    replace(
        _ADAPTER,
        publishes=_ADAPTER.publishes | {"lbr/command/torque", topics.JOINT_STATES.name},
        subscribes=_ADAPTER.subscribes | _OF_KUKA,
    ),
    replace(_RECORDER, subscribes=_RECORDER.subscribes | set(topics.OF_OTHERS)),
    _managed(VIEWER, HEARD_BY_VIEWER, calls=_STOP_AND_RESET),
)

INTERFACES = {
    **dict(zip(MANAGED, _LIFECYCLE, strict=True)),
    "bringup": _node(
        [],
        [topics.JOINT_STATES, topics.ROBOT_DESCRIPTION],
        calls=[
            *(f"{name}/get_state" for name in MANAGED),
            *(f"{name}/change_state" for name in ("driver", "controller", "observer")),
            "controller/stop",
        ],
    ),
    DOCTOR: replace(_DOCTOR, subscribes=_DOCTOR.subscribes | _OF_KUKA),
    OPERATOR: _node(
        [topics.GOAL_POSE.name],
        [
            topics.JOINT_STATES,
            topics.GOAL_STATE,
            topics.SAFETY_STATE,
            topics.DIAGNOSTICS,
            topics.SETTINGS,
            topics.CLOCK,
        ],
        calls=[*_STOP_AND_RESET, "planner/set_parameters_atomically"],
    ),
    REPLAY: _node([f"{REPLAY}/{topic.name}" for topic in topics.ALL], []),
}
"""All nodes of the package, by name."""
