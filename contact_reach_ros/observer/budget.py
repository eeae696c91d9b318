"""The contact budget: how hard the arm may touch, read by planner and observer alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.table import excessive
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.resources import config_file
from contact_reach_ros.settings import Settings, read_yaml, setting

BUDGET = "budget"
"""Prefix of the contact budget among the settings that nodes report: it comes from a file of its own."""

MAX_THRESHOLD = 50000.0
"""Greatest threshold of a joint, Nm: half the greatest torque limit that descriptions have."""


def _per_joint(description: str, unit: str, minimum: float) -> tuple[float, ...]:
    description = f"{description}, joint by joint"
    return setting(None, description, unit=unit, minimum=minimum, maximum=MAX_THRESHOLD, per_joint=True)


@dataclass(frozen=True)
class ContactBudget(Settings):
    """Permitted contact.

    The thresholds on the external torque of joint i grow with its speed: ε_i = ε0_i + c_i |q̇_i|. Sudden torque is the
    deviation from what an error of the model explains, see `Baseline`.
    Thresholds that are not given are the arm's own, see `resolve`.
    """

    permitted_force: float = setting(
        10.0, "ε: largest contact force on one robot body that a plan may have", unit="N", minimum=0.0, maximum=140.0
    )
    torque_thresholds: tuple[float, ...] = _per_joint("external torque on a joint that stops the arm", "Nm", 0.01)
    torque_per_speed: tuple[float, ...] = _per_joint(
        "increase of the thresholds that stop the arm with joint speed", "Nm s/rad", 0.0
    )
    sudden_thresholds: tuple[float, ...] = _per_joint(
        "sudden external torque on a joint that stops the arm", "Nm", 0.01
    )
    contact_thresholds: tuple[float, ...] = _per_joint(
        "sudden external torque on a joint that counts as contact", "Nm", 0.001
    )
    contact_per_speed: tuple[float, ...] = _per_joint("increase of the contact thresholds with speed", "Nm s/rad", 0.0)
    handover_thresholds: tuple[float, ...] = _per_joint(
        "external torque on a joint at hand-over that stops the arm: the model of its weight is wrong",
        "Nm",
        0.01,
    )

    def resolve(self, arm: Arm) -> Self:
        """As any settings; raises `SettingsError`, too, where a threshold exceeds the torque that a joint can take."""
        budget = super().resolve(arm)
        for wrong in excessive(vars(budget), arm.torque_limits):
            raise SettingsError(f"contact budget: {wrong}")
        return budget


DEFAULT_BUDGET_FILE = "contact_budget.yaml"


def budget_file(path: str | Path = "") -> Path:
    """Path of a contact budget; by default the one that comes with the package."""
    return Path(path) if path else config_file(DEFAULT_BUDGET_FILE)


def load_budget(path: str | Path = "") -> ContactBudget:
    """Read a contact budget; by default the one that comes with the package.

    Raises
    ------
    SettingsError
        If the file is missing or not YAML, or has an unknown key or a value out of range; the message names it.
    """
    file = budget_file(path)
    return ContactBudget.from_mapping(read_yaml(file), str(file))
