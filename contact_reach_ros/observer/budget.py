"""The contact budget: how hard the arm may touch, read by planner and observer alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import Settings, read_yaml, setting


@dataclass(frozen=True)
class ContactBudget(Settings):
    """Permitted contact."""

    permitted_force: float = setting(
        10.0, "ε: largest contact force on one robot body that a plan may have", unit="N", minimum=0.0, maximum=140.0
    )
    torque_thresholds: tuple[float, ...] = setting(
        (30.0, 30.0, 25.0, 25.0, 15.0, 10.0, 8.0),
        "external torque on a joint that stops the arm, A1 to A7",
        unit="Nm",
        minimum=0.5,
        maximum=320.0,
    )


DEFAULT_BUDGET_FILE = "contact_budget.yaml"


def load_budget(path: str | Path = "") -> ContactBudget:
    """Read a contact budget; the one that comes with the package when no path is given.

    Raises
    ------
    SettingsError
        If the file is missing or not YAML, or has an unknown key or a value out of range; file and key are named.
    """
    file = Path(path) if path else config_file(DEFAULT_BUDGET_FILE)
    return ContactBudget.from_mapping(read_yaml(file), str(file))
