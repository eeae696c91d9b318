"""Whether planner and controller have the same arm, rate and gains: a plan for others is not what the arm will do.

And whether the observer has the settings with which the controller watches itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import ROBOT, ROBOT_DIGEST
from contact_reach_ros.control.settings import ImpedanceSettings

SHARED = (ROBOT, *(f"tool.{entry.name}" for entry in Tool.declared()), ROBOT_DIGEST, "state_rate")
"""Settings of every node that a plan depends on."""

SHARED_SECTION = "impedance."
"""Prefix of the gains, which the planner has to know to predict what the controller will do."""

MAX_POSITION_ERROR = "supervision.max_position_error"
"""Setting above which the controller drops a plan, which the planner has to know, too."""


def plan_basis(arm: Arm, gains: ImpedanceSettings, max_position_error: float) -> dict[str, Any]:
    """What plans are made for, by the full names of the settings: the arm, and the controller that follows them."""
    basis = {ROBOT: arm.name, ROBOT_DIGEST: arm.digest, MAX_POSITION_ERROR: max_position_error}
    return basis | {SHARED_SECTION + name: value for name, value in asdict(gains).items()}


def disagreement(own: Mapping[str, Any], planners: Mapping[str, Any]) -> str:
    """What the planner plans with and the controller has not, as `differences` has it."""
    names = [name for name in own if name.startswith(SHARED_SECTION)]
    return differences(own, planners, "planner", [*names, MAX_POSITION_ERROR])


def differences(own: Mapping[str, Any], others: Mapping[str, Any], other: str, names: Iterable[str]) -> str:
    """What another node has and the controller has not, with both values; empty when they agree.

    Parameters
    ----------
    own, others
        Settings of the controller and of the other node by their full names; what the other one does not report is not
        compared.
    other
        Name of the other node.
    names
        Settings to compare besides `SHARED`.
    """
    found = [
        f"{name} = {others[name]} in the {other}, {own[name]} in the controller"
        for name in (*SHARED, *names)
        if name in own and name in others and _plain(others[name]) != _plain(own[name])
    ]
    return "; ".join(found)


def _plain(value: Any) -> Any:
    """The value as it comes out of JSON."""
    return list(value) if isinstance(value, tuple) else value
