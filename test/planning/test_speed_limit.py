"""The shortest time to a target against the arm's impedance law, as an acceleration along one axis."""

import math

import numpy as np
import pytest

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.speed_limit import least_duration, steady_speed

START = np.array([0.5, 0.1, 0.6])


@pytest.mark.parametrize("gains", [{}, {"task_stiffness": 400.0}, {"task_damping": 50.0}])
@pytest.mark.parametrize("bound", [0.01, 0.03])
def test_a_mass_that_is_pulled_as_far_as_permitted_needs_that_long(gains, bound):
    planning, impedance = PlanningSettings(translation_bound=bound), ImpedanceSettings(**gains)
    distance = 2.0
    x, v, time, step = 0.0, 0.0, 0.0, 1e-3
    while x < distance:
        # ẍ = Kp γ - Kd ẋ: law (1) with the reference always the bound ahead.
        v += step * (impedance.task_stiffness * bound - impedance.task_damping * v)
        x += step * v
        time += step
    least = least_duration(START, START + np.array([0.0, -distance, 0.3]), planning, impedance)
    # It is still to gain speed, for which it takes the time constant 1 / Kd.
    assert least == pytest.approx(time - 1.0 / impedance.task_damping, abs=2 * step)
    assert least <= time


def test_the_farthest_axis_counts_in_either_direction():
    def least(*offset: float) -> float:
        return least_duration(START, START + offset, PlanningSettings(), ImpedanceSettings())

    assert least(0.1, -0.3, 0.2) == pytest.approx(least(0.3, 0.0, 0.0))
    assert least(0.1, -0.3, 0.2) == pytest.approx(3 * least(0.0, 0.0, 0.1))
    assert least(0.0, 0.0, 0.0) == 0.0


def test_without_stiffness_only_the_start_is_reached():
    slack = ImpedanceSettings(task_stiffness=0.0)
    assert least_duration(START, START + 0.1, PlanningSettings(), slack) == math.inf
    assert least_duration(START, START, PlanningSettings(), slack) == 0.0
    assert steady_speed(PlanningSettings(), ImpedanceSettings(task_stiffness=0.0, task_damping=0.0)) == 0.0


def test_without_damping_no_speed_is_too_high():
    free = ImpedanceSettings(task_damping=0.0)
    assert steady_speed(PlanningSettings(), free) == math.inf
    assert least_duration(START, START + 0.1, PlanningSettings(), free) == 0.0
