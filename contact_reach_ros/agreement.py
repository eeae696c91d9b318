"""Which settings two nodes have to have alike, and where they differ.

The planner predicts what the controller will do: a plan for another arm, rate or gains is not what the arm does. And
the controller watches itself with the settings of the observer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import ROBOT, ROBOT_DIGEST, TOOL_PARAMETERS
from contact_reach_ros.control.settings import ControllerSettings

_EVERYWHERE = (ROBOT, *TOOL_PARAMETERS, ROBOT_DIGEST, "state_rate")
"""Settings of every node that have to be the same."""
_GAINS, _MAX_POSITION_ERROR, _BODY_SPEED = "impedance.", "supervision.max_position_error", "limits.body_speed"
OF_PLANS = (_GAINS, _MAX_POSITION_ERROR, _BODY_SPEED)
"""Prefixes of the settings of the controller that the planner has to know, too."""


def plan_basis(arm: Arm, controller: ControllerSettings) -> dict[str, Any]:
    """What plans are made for, by the full names of the settings: the arm, and the controller that follows them."""
    return {
        ROBOT: arm.name,
        ROBOT_DIGEST: arm.digest,
        _MAX_POSITION_ERROR: controller.supervision.max_position_error,
        _BODY_SPEED: controller.limits.body_speed,
        **{_GAINS + name: value for name, value in asdict(controller.impedance).items()},
    }


def differences(own: Mapping[str, Any], others: Mapping[str, Any], other: str, prefixes: tuple[str, ...]) -> str:
    """What another node has and the controller has not, with both values; empty when they agree.

    Parameters
    ----------
    own, others
        Settings of the controller and of the other node by their full names; what the other one does not report is not
        compared.
    other
        Name of the other node.
    prefixes
        Of the names to compare besides those that all nodes have.
    """
    names = (*_EVERYWHERE, *(name for name in own if name.startswith(prefixes)))
    found = [
        f"{name} = {others[name]} in the {other}, {own[name]} in the controller"
        for name in names
        if name in own and name in others and _plain(others[name]) != _plain(own[name])
    ]
    return "; ".join(found)


def _plain(value: Any) -> Any:
    """The value as it comes out of JSON."""
    return list(value) if isinstance(value, tuple) else value
