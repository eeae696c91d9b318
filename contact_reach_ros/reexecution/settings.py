"""Settings of a recorded stack: as the nodes had them, or with changes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.arm.joint_state import REST_SPEED
from contact_reach_ros.arms import ROBOT, ROBOT_DIGEST, ROBOT_TABLE, TOOL_PARAMETERS
from contact_reach_ros.control import constants, controller, stop_watch, supervisor
from contact_reach_ros.control.settings import (
    CONTROLLER_SECTIONS,
    SINGULARITY_FLOOR,
    ImpedanceSettings,
    SupervisionSettings,
)
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.obstacle_reader import NODE_DAMPING, SPHERE_DAMPING
from contact_reach_ros.observer import plausibility, safety
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.settings import PLANNER_SECTIONS
from contact_reach_ros.settings import Sections, check_node_names, full_name, parameters_in, unknown_key
from contact_reach_ros.world.goal import TOLERANCE

BUDGET = "budget"
"""Prefix of the contact budget, which comes from a file of its own."""
GAINS, SUPERVISION = "impedance", "supervision"
"""Prefixes of the controller's settings that the planner has, too."""

SECTIONS: Mapping[str, Sections] = {
    "controller": {**CONTROLLER_SECTIONS, **OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "observer": {**OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "planner": {
        **PLANNER_SECTIONS,
        GAINS: ImpedanceSettings,
        SUPERVISION: SupervisionSettings,
        BUDGET: ContactBudget,
    },
}
"""What the nodes that are re-executed record, by parameter prefix."""

FIXED: Mapping[str, Any] = {
    "impedance.singularity_floor": SINGULARITY_FLOOR,
    "limits.joint_limit_margin": constants.REPULSION_MARGIN,
    "limits.joint_limit_torque_share": constants.REPULSION_SHARE,
    "limits.joint_limit_damping": constants.REPULSION_DAMPING,
    "limits.null_velocity_share": constants.BRAKED_SHARE,
    "limits.velocity_limit_share": constants.CEILING_SHARE,
    "limits.velocity_limit_rate": constants.CEILING_RATE,
    "supervision.start_ramp": controller.START_RAMP,
    "supervision.hold_blend": controller.HOLD_BLEND,
    "supervision.max_plan_lead": controller.MAX_PLAN_LEAD,
    "supervision.max_plan_duration": controller.MAX_PLAN_DURATION,
    "supervision.watch_rate": controller.WATCH_RATE,
    "supervision.observer_patience": supervisor.OBSERVER_PATIENCE,
    "supervision.observer_timeout": supervisor.OBSERVER_TIMEOUT,
    "supervision.reset_velocity": REST_SPEED,
    "supervision.correct_stop": True,
    "supervision.velocity_share": 1.0,
    "supervision.velocity_debounce": stop_watch.SPEED_DEBOUNCE,
    "supervision.stop_speed_gain": stop_watch.SPEED_GAIN,
    "supervision.stop_creep": stop_watch.CREEP,
    "supervision.rest_within": stop_watch.REST_WITHIN,
    "supervision.brake_after": stop_watch.BRAKE_AFTER,
    "safety.contact_release": safety.RELEASE_SHARE,
    "safety.release_debounce": safety.RELEASE_DEBOUNCE,
    f"{BUDGET}.handover_time": safety.HANDOVER_TIME,
    "safety.handover_debounce": safety.HANDOVER_DEBOUNCE,
    "safety.mean_time": safety.MEAN_TIME,
    "safety.model_error_per_rad": safety.MODEL_ERROR_PER_RAD,
    "safety.model_error_at_rest": safety.MODEL_ERROR_AT_REST,
    "safety.reset_share": safety.RESET_SHARE,
    "safety.reset_velocity": REST_SPEED,
    "plausibility.frozen_time": plausibility.FROZEN_TIME,
    "plausibility.frozen_torque_time": plausibility.FROZEN_TORQUE_TIME,
    "torque_source": "measured",
    "goal_tolerance": TOLERANCE,
    "sphere_damping": SPHERE_DAMPING,
    "node_damping": NODE_DAMPING,
    "node_stiffness": 0.0,
}
"""Settings that version 0.2 recorded and this one has as constants: the only values that it can re-execute."""

MODEL = "model"
"""Stands for a node in a parameter file: its parameter inertia_set is the model that controller and observer have."""

_INERTIA_SET = "inertia_set"
_CONTACT_BUDGET = "contact_budget"
_WITHOUT_EFFECT = ("commanded.threshold_factor", "commanded.handover_time", "commanded.lost", "planning.device")
"""Settings that version 0.2 recorded, and that changed nothing with the values of `FIXED` or not the plans."""
_EVERY_NODE = ("use_sim_time", ROBOT, ROBOT_DIGEST, ROBOT_TABLE, "state_rate", *TOOL_PARAMETERS)
_OF_PROCESSES = ("use_sim_time", ROBOT, "autostart", "cpus", "state_rate", *TOOL_PARAMETERS)
"""Parameters of every node that do not change what it computes."""


def recorded_sections(node: str, recorded: Mapping[str, Any], bag: object) -> dict[str, Any]:
    """The settings objects of a node by prefix; `recorded` are its values by full name.

    Raises
    ------
    BagError
        If a name or a value is none of this version's: the node may have worked in another way. `bag` is named.
    """
    source = f"bag '{bag}', settings of the {node}"
    for name in FIXED.keys() & recorded.keys():
        if recorded[name] != FIXED[name]:
            raise BagError(
                f"{source}: {name} = {recorded[name]}; expected {FIXED[name]}, which is fixed since version 0.3.0; use "
                "the version that recorded the bag"
            )
    try:
        values = _by_prefix(node, recorded, (*FIXED, *_WITHOUT_EFFECT, *_EVERY_NODE), source)
        return {prefix: kind.from_mapping(values[prefix], source) for prefix, kind in SECTIONS[node].items()}
    except SettingsError as error:
        raise BagError(f"{error}; use the version that recorded the bag") from error


class ChangedSettings:
    """Settings to re-execute with instead of the recorded ones, from a parameter file; without one nothing changes.

    Attributes
    ----------
    file
        The parameter file.
    inertia_set
        The inertial parameters that controller and observer have.
    """

    def __init__(self, file: Path | None = None) -> None:
        """Raises `SettingsError` if the file cannot be read, names no node, or a parameter that the node has not."""
        self.file = file
        if file is not None:
            check_node_names(file, [MODEL])
        nodes = (*SECTIONS, MODEL)
        found = {node: {} if file is None else parameters_in(file, node) for node in nodes}
        if file is not None and not any(found.values()):
            raise SettingsError(f"{file}: names none of {', '.join(nodes)}; expected '<node>: ros__parameters: ...'")
        model = found.pop(MODEL)
        self.inertia_set = str(model.pop(_INERTIA_SET, "nominal"))
        for name in model:
            raise SettingsError(unknown_key(name, [_INERTIA_SET], f"{file}: {MODEL}"))
        self._changes = {
            node: _by_prefix(node, values, _OF_PROCESSES, f"{file}: {node}") for node, values in found.items()
        }
        # The planner plans for the controller's gains and supervision.
        for prefix in (GAINS, SUPERVISION):
            self._changes["planner"][prefix] = self._changes["controller"][prefix] | self._changes["planner"][prefix]
        # The controller watches itself with the observer's.
        self._changes["controller"] |= {prefix: self._changes["observer"][prefix] for prefix in OBSERVER_SECTIONS}

    def __bool__(self) -> bool:
        return self.file is not None

    def apply(self, node: str, recorded: Mapping[str, Any]) -> dict[str, Any]:
        """The settings objects of a node by prefix: the recorded ones with what the file changes.

        Raises `SettingsError` if a value is not accepted.
        """
        made = dict(recorded)
        for prefix, own in self._changes[node].items():
            if own:
                settings = recorded[prefix]
                made[prefix] = type(settings).from_mapping(vars(settings) | own, f"{self.file}: {node}")
        own = self._changes[node].get("", {})
        if _CONTACT_BUDGET in own:
            made[BUDGET] = load_budget(own[_CONTACT_BUDGET])
        return made


def _by_prefix(
    node: str, values: Mapping[str, Any], ignored: Collection[str], source: str
) -> dict[str, dict[str, Any]]:
    """The settings of a node by prefix and own name; raises `SettingsError` if it has none of that full name."""
    known = {
        full_name(prefix, entry.name): (prefix, entry.name)
        for prefix, kind in SECTIONS[node].items()
        for entry in kind.declared()
    }
    found: dict[str, dict[str, Any]] = {prefix: {} for prefix in SECTIONS[node]}
    for name, value in values.items():
        if name in known:
            prefix, own = known[name]
            found[prefix][own] = value
        elif name not in ignored:
            raise SettingsError(unknown_key(name, known, source))
    return found
