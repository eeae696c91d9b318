"""How fast bounded steps of the reference can pull the arm."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings

Array = NDArray[np.float64]


def least_duration(
    start_position: Array, target: Array, planning: PlanningSettings, impedance: ImpedanceSettings
) -> float:
    """Shortest time in which the flange can come from a position (3,) to another, m, base frame; in s.

    Under law (1) no axis of the flange moves steadily faster than γ Kp / Kd: at that speed the damping takes all that
    the stiffness gives, since γ bounds Δx. The time is that of the axis with the farthest to go; infinite without
    stiffness, unless there is nowhere to go.
    """
    distance = float(np.abs(target - start_position).max())
    pull = planning.translation_bound * impedance.task_stiffness
    if distance == 0.0:
        return 0.0
    return distance * impedance.task_damping / pull if pull > 0.0 else math.inf
