"""Speed at which bounded steps of the reference can pull the arm."""

from __future__ import annotations

import math

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings


def steady_speed(planning: PlanningSettings, impedance: ImpedanceSettings) -> float:
    """Greatest steady speed of an axis of the flange under law (1), m/s: γ Kp / Kd.

    At that speed the damping balances the stiffness, since γ bounds Δx. Infinite without damping.
    """
    pull = planning.translation_bound * impedance.task_stiffness
    if impedance.task_damping == 0.0:
        return math.inf if pull > 0.0 else 0.0
    return pull / impedance.task_damping


def least_duration(
    start_position: Array, target: Array, planning: PlanningSettings, impedance: ImpedanceSettings
) -> float:
    """Shortest time in which the flange can move from one position (3,) to another, m, base frame; in s.

    The axis with the farthest to go determines it, at `steady_speed`; infinite without stiffness, unless the distance
    is zero.
    """
    distance = float(np.abs(target - start_position).max())
    if distance == 0.0:
        return 0.0
    speed = steady_speed(planning, impedance)
    return distance / speed if speed > 0.0 else math.inf
