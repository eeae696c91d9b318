"""The content of `goal/state`: what happened to a goal."""

from __future__ import annotations

import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from contact_reach_ros.arm import Arm
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.conversions import to_status
from contact_reach_ros.messages.safety_state import OK, WARN
from contact_reach_ros.messages.values import GOAL_PHASE, GOAL_STAMP
from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState

_REASON = "reason"
_DISTANCE, _ANGLE, _ELAPSED = "distance m", "angle rad", "elapsed s"


def describe(state: GoalState) -> str:
    """The state in words: the phase, then why, or how far from the goal the flange is and after what time."""
    if state.reason:
        return f"{state.phase.value}: {state.reason}"
    if math.isnan(state.distance):
        return state.phase.value
    distance, angle = 1000.0 * state.distance, math.degrees(state.angle)
    return f"{state.phase.value}: {distance:.1f} mm and {angle:.1f} deg from the goal after {state.elapsed:.2f} s"


def to_goal_state(state: GoalState, stamp_ns: int, name: str, arm: Arm) -> DiagnosticStatus:
    """The message of the node `name` about the goal with this stamp, ns."""
    values = {
        GOAL_STAMP: stamp_ns,
        GOAL_PHASE: state.phase.value,
        _DISTANCE: f"{state.distance:.6g}",
        _ANGLE: f"{state.angle:.6g}",
        _ELAPSED: f"{state.elapsed:.3f}",
        _REASON: state.reason,
    }
    return to_status(name, describe(state), values, WARN if state.phase.is_over else OK, arm.name)


def read_goal_state(message: Any) -> tuple[int, GoalState]:
    """The stamp of the goal, ns, and its state; raises `InputError` if a value is missing or malformed."""
    values = {item.key: item.value for item in message.values}
    try:
        distance, angle, elapsed = (float(values[key]) for key in (_DISTANCE, _ANGLE, _ELAPSED))
        phase, reason = GoalPhase(values[GOAL_PHASE]), values[_REASON]
        return int(values[GOAL_STAMP]), GoalState(phase, reason, distance, angle, elapsed)
    except (KeyError, ValueError) as error:
        raise InputError(f"goal/state: {error}; expected the values that the planner publishes") from error
