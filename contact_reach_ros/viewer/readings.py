"""What the page shows of messages, whether they come by topic or from a bag: of any object with their fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.goals import goal_in
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial
from contact_reach_ros.messages.safety_state import is_stopped, read_contact, read_level
from contact_reach_ros.messages.values import FARTHEST, numbers
from contact_reach_ros.viewer.frame import SafetyLevel, SafetyStatus

ANY_MATERIAL = AssumedMaterial(1.0, 1.0, 1.0, 1.0, 1.0)
"""Of obstacles: only positions, radii and edges are shown."""


def planned_goal(message: Any) -> Array | None:
    """The goal (3,), m, of the plan in a plan/statistics message; None if it has none.

    Raises `InputError` if it is nowhere.
    """
    goal = goal_in({key.rpartition("/")[2]: value for key, value in named_numbers(message).items()})
    if goal is not None and not (np.abs(goal) < FARTHEST).all():
        raise InputError(f"plan/statistics: goal = {goal.tolist()}; expected numbers below {FARTHEST:g} m")
    return goal


def safety_status(message: Any, arm: Arm) -> SafetyStatus:
    """The state of a node in a safety_state message; a malformed contact is left out."""
    try:
        contact = read_contact(message, arm)
    except InputError:
        contact = None
    level = (
        SafetyLevel.STOP if is_stopped(message) else SafetyLevel(min(read_level(message), SafetyLevel.CONTACT.value))
    )
    return SafetyStatus(level, message.message, contact)


def named_numbers(message: Any) -> Mapping[str, float]:
    """Numbers among the values of a DiagnosticArray, by '<node>/<key>'."""
    return {f"{status.name}/{key}": value for status in message.status for key, value in numbers(status)}
