"""Settings of a recorded stack: as the nodes had them, or with changes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import ROBOT_DIGEST, ROBOT_TABLE, known_parameters, load_arm
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, ImpedanceSettings, SupervisionSettings
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.settings import PLANNER_SECTIONS
from contact_reach_ros.removed import removed_parameter
from contact_reach_ros.settings import (
    Sections,
    check_name,
    check_node_names,
    make_settings,
    parameters_in,
    unknown_key,
)

BUDGET = "budget"
"""Prefix of the contact budget, which comes from a file of its own."""

SECTIONS: Mapping[str, Sections] = {
    "controller": {**CONTROLLER_SECTIONS, **OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "observer": {**OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "planner": {
        **PLANNER_SECTIONS,
        "impedance": ImpedanceSettings,
        "supervision": SupervisionSettings,
        BUDGET: ContactBudget,
    },
}
"""What the nodes that are re-executed record, by parameter prefix."""

MODEL = "model"
"""Stands for a node in a parameter file: its parameter inertia_set is the model that controller and observer have."""

_INERTIA_SET = "inertia_set"
_CONTACT_BUDGET = "contact_budget"
_OF_BAGS = (ROBOT_DIGEST, ROBOT_TABLE)
"""What nodes report of their arm, beside parameters."""


def recorded_sections(node: str, recorded: Mapping[str, Any], arm: Arm, bag: object) -> dict[str, Any]:
    """The settings objects of a node by prefix; `recorded` are its values by full name.

    Settings that version 0.2 had and this one has as constants are left out: re-execution shows whether they differed.

    Raises
    ------
    BagError
        If a name or a value is none of this version's: the node may have worked in another way. `bag` is named.
    """
    source = f"bag '{bag}', settings of the {node}"
    try:
        gone = {name for name in recorded if removed_parameter(name.removeprefix(f"{BUDGET}."))}
        _check_names(node, recorded.keys() - gone - {*_OF_BAGS}, source)
        return make_settings(recorded, SECTIONS[node], arm, source)
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
        self.inertia_set = "nominal"
        self._changes: dict[str, dict[str, Any]] = {}
        if file is None:
            return
        check_node_names(file, [MODEL])
        self._changes = {node: parameters_in(file, node) for node in (*SECTIONS, MODEL)}
        if not any(self._changes.values()):
            nodes = ", ".join(self._changes)
            raise SettingsError(f"{file}: names none of {nodes}; expected '<node>: ros__parameters: ...'")
        model = self._changes.pop(MODEL)
        self.inertia_set = str(model.pop(_INERTIA_SET, self.inertia_set))
        for name in model:
            raise SettingsError(unknown_key(name, [_INERTIA_SET], f"{file}: {MODEL}"))
        for node, values in self._changes.items():
            _check_names(node, values, f"{file}: {node}")
        # The planner plans for the controller's gains and supervision, the controller watches itself with the
        # observer's settings.
        self._changes["planner"] = self._changes["controller"] | self._changes["planner"]
        self._changes["controller"] |= self._changes["observer"]

    def __bool__(self) -> bool:
        return self.file is not None

    def apply(self, node: str, recorded: Mapping[str, Any], arm: Arm) -> dict[str, Any]:
        """The settings objects of a node by prefix: the `recorded` values by full name with what the file changes.

        Raises `SettingsError` if a value is not accepted.
        """
        own = self._changes.get(node, {})
        made = make_settings({**recorded, **own}, SECTIONS[node], arm, f"{self.file}: {node}")
        if _CONTACT_BUDGET in own:
            made[BUDGET] = load_budget(own[_CONTACT_BUDGET]).resolve(arm)
        return made


def _check_names(node: str, names: Iterable[str], source: str) -> None:
    """Raise `SettingsError` if a node has no parameter of one of the names."""
    known = known_parameters(SECTIONS[node], load_arm())
    for name in names:
        check_name(known, name, source)
