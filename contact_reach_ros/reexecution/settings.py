"""Settings of a recorded stack: as the nodes had them, or with changes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.arms import ROBOT, ROBOT_DIGEST, ROBOT_TABLE, TOOL_PARAMETERS
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, ImpedanceSettings, SupervisionSettings
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.settings import PLANNER_SECTIONS
from contact_reach_ros.removed import removed_parameter
from contact_reach_ros.settings import Sections, check_node_names, full_name, parameters_in, unknown_key

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

MODEL = "model"
"""Stands for a node in a parameter file: its parameter inertia_set is the model that controller and observer have."""

_INERTIA_SET = "inertia_set"
_CONTACT_BUDGET = "contact_budget"
_OF_PROCESSES = ("use_sim_time", ROBOT, ROBOT_DIGEST, ROBOT_TABLE, "autostart", "cpus", "state_rate", *TOOL_PARAMETERS)
"""Parameters of every node that do not change what it computes."""


def recorded_sections(node: str, recorded: Mapping[str, Any], bag: object) -> dict[str, Any]:
    """The settings objects of a node by prefix; `recorded` are its values by full name.

    Settings that version 0.2 had and this one has as constants are left out: re-execution shows whether they differed.

    Raises
    ------
    BagError
        If a name or a value is none of this version's: the node may have worked in another way. `bag` is named.
    """
    source = f"bag '{bag}', settings of the {node}"
    kept = {name: value for name, value in recorded.items() if not removed_parameter(name)}
    try:
        values = _by_prefix(node, kept, source)
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
        self._changes = {node: _by_prefix(node, values, f"{file}: {node}") for node, values in found.items()}
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


def _by_prefix(node: str, values: Mapping[str, Any], source: str) -> dict[str, dict[str, Any]]:
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
        elif name not in _OF_PROCESSES:
            raise SettingsError(unknown_key(name, known, source))
    return found
