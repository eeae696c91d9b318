"""The shortest time to a target against the arm's impedance law, as an acceleration along one axis."""

import numpy as np
import pytest

from benchmarks.metrics import least_duration
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings

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
