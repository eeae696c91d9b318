"""The contact budget: how hard the arm may touch, read by planner and observer alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import Settings, read_yaml, setting


def _per_joint(default: tuple[float, ...], description: str, unit: str, minimum: float) -> tuple[float, ...]:
    return setting(default, f"{description}, A1 to A7", unit=unit, minimum=minimum, maximum=320.0)


@dataclass(frozen=True)
class ContactBudget(Settings):
    """Permitted contact.

    The thresholds on the external torque of joint i grow with its speed: ε_i = ε0_i + c_i |q̇_i|. What is called sudden
    is measured from the external torque's own slow mean, which takes up the error of the model.
    """

    permitted_force: float = setting(
        10.0, "ε: largest contact force on one robot body that a plan may have", unit="N", minimum=0.0, maximum=140.0
    )
    torque_thresholds: tuple[float, ...] = _per_joint(
        (30.0, 30.0, 25.0, 25.0, 15.0, 10.0, 8.0), "external torque on a joint that stops the arm", "Nm", 0.5
    )
    torque_per_speed: tuple[float, ...] = _per_joint(
        (2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0), "what is added to the thresholds that stop the arm", "Nm s/rad", 0.0
    )
    sudden_thresholds: tuple[float, ...] = _per_joint(
        (12.0, 12.0, 9.0, 9.0, 5.0, 5.0, 4.0), "sudden external torque on a joint that stops the arm", "Nm", 0.5
    )
    contact_thresholds: tuple[float, ...] = _per_joint(
        (2.5, 2.5, 2.0, 2.0, 1.4, 1.4, 1.4), "sudden external torque on a joint that is a contact", "Nm", 0.05
    )
    contact_per_speed: tuple[float, ...] = _per_joint(
        (1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5), "what is added to the thresholds of a contact", "Nm s/rad", 0.0
    )
    handover_thresholds: tuple[float, ...] = _per_joint(
        (8.0, 10.0, 6.0, 6.0, 3.0, 3.0, 3.0),
        "external torque on a joint at hand-over that stops the arm: the model of its weight is wrong",
        "Nm",
        0.5,
    )
    handover_time: float = setting(
        0.3,
        "how long the hand-over lasts from the moment the acting torque is known",
        unit="s",
        minimum=0.0,
        maximum=5.0,
    )


DEFAULT_BUDGET_FILE = "contact_budget.yaml"


def budget_file(path: str | Path = "") -> Path:
    """The file of a contact budget; the one that comes with the package when no path is given."""
    return Path(path) if path else config_file(DEFAULT_BUDGET_FILE)


def load_budget(path: str | Path = "") -> ContactBudget:
    """Read a contact budget; the one that comes with the package when no path is given.

    Raises
    ------
    SettingsError
        If the file is missing or not YAML, or has an unknown key or a value out of range; file and key are named.
    """
    file = budget_file(path)
    return ContactBudget.from_mapping(read_yaml(file), str(file))
