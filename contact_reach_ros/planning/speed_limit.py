"""How fast bounded steps of the reference can pull the arm."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings

Array = NDArray[np.float64]


def steady_speed(planning: PlanningSettings, impedance: ImpedanceSettings) -> float:
    """Fastest that an axis of the flange can move steadily under law (1), m/s: γ Kp / Kd.

    At that speed the damping takes all that the stiffness gives, since γ bounds Δx. Infinite without damping.
    """
    pull = planning.translation_bound * impedance.task_stiffness
    if impedance.task_damping == 0.0:
        return math.inf if pull > 0.0 else 0.0
    return pull / impedance.task_damping


def least_duration(
    start_position: Array, target: Array, planning: PlanningSettings, impedance: ImpedanceSettings
) -> float:
    """Shortest time in which the flange can come from a position (3,) to another, m, base frame; in s.

    The time is that of the axis with the farthest to go at `steady_speed`; infinite without stiffness, unless there is
    nowhere to go.
    """
    distance = float(np.abs(target - start_position).max())
    if distance == 0.0:
        return 0.0
    speed = steady_speed(planning, impedance)
    return distance / speed if speed > 0.0 else math.inf
