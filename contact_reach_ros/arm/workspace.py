"""Reachable positions of the flange."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array


def unreachable(arm: Arm, position: Array) -> str:
    """Why the flange cannot be at `position` (3,), m, base frame; empty if no reason is known.

    Reasons are a position farther from the shoulder than the arm reaches, and one inside the base. The text continues a
    sentence that begins with the name of the position.
    """
    distance = float(np.linalg.norm(position - arm.shoulder))
    if distance > arm.reach:
        return f"is {distance:.3f} m from the shoulder at {list(arm.shoulder)} m; the arm reaches {arm.reach} m"
    base = arm.base_capsule
    axis_point = np.array([0.0, 0.0, np.clip(position[2], 0.0, base.end[2])])
    if np.linalg.norm(position - axis_point) < base.radius:
        place = np.round(position, 3).tolist()
        return f"= {place} m lies inside the base; expected at least {base.radius} m from its axis"
    return ""
