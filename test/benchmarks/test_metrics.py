"""Figures of episodes whose motion is known in closed form."""

import numpy as np
import pytest

from benchmarks.episode_result import EpisodeResult
from benchmarks.metrics import measure
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import PlanningSettings

START = np.array([0.4, 0.0, 0.5])
TARGET = START + np.array([0.12, 0.0, 0.16])
TIMES = 0.001 * np.arange(1, 2001)


def episode(positions, **changes):
    """An episode along these positions, in which nothing else happens."""
    count = len(positions)
    values = {
        "duration": 0.001 * count,
        "start_position": START,
        "positions": positions,
        "joints": np.zeros((count, 7)),
        "link_forces": np.zeros((count, 6)),
        "external_torques": np.zeros((count, 7)),
        "distances": np.full(count, 0.009),
        "stop_reason": "",
        "failure": "",
        "plans": [],
    }
    return EpisodeResult(**{**values, **changes})


def straight(count=2000, speed=0.1):
    return START + speed * TIMES[:count, None] * np.array([0.6, 0.0, 0.8])


def measured(*arguments, **changes):
    return measure(episode(*arguments, **changes), TARGET, PlanningSettings(), ImpedanceSettings(), 10.0)


def test_a_straight_motion_is_as_long_as_its_displacement():
    metrics = measured(straight())
    assert (metrics.path_length, metrics.path_ratio) == (pytest.approx(0.2), pytest.approx(1.0))
    assert metrics.reached and metrics.time == pytest.approx(2.0)
    # The slowest axis decides: 0.16 m at 0.088 m/s.
    assert metrics.time_ratio == pytest.approx(2.0 / (0.16 / 0.088))
    assert (metrics.end_error, metrics.end_speed) == (0.009, pytest.approx(0.1))


def test_forces_torques_and_impulse():
    forces, torques = np.zeros((2000, 6)), np.zeros((2000, 7))
    forces[100:600, 2], forces[100:600, 3] = 12.0, 4.0
    forces[700:900, 5] = 5.0
    torques[50, 4], torques[60, 1] = -7.5, 3.0
    metrics = measured(straight(), link_forces=forces, external_torques=torques)
    assert (metrics.max_contact_force, metrics.max_external_torque) == (12.0, 7.5)
    assert metrics.contact_impulse == pytest.approx(12.0 * 0.5 + 5.0 * 0.2)
    assert metrics.over_budget == pytest.approx(0.5)


def test_without_a_first_plan_there_is_nothing_to_measure():
    metrics = measured(np.zeros((0, 3)), duration=float("nan"), failure="no path")
    assert (metrics.failure, metrics.end_error, metrics.end_speed) == ("no path", None, None)
    assert metrics.path_length == metrics.max_contact_force == metrics.max_external_torque == 0.0


def test_a_goal_that_asks_for_rest_is_reached_when_the_tip_has_settled():
    passing = measured(straight(), until_settled=True)
    assert (passing.reached, passing.time, passing.entry_time) == (False, None, pytest.approx(2.0))
    settled = measured(straight(), until_settled=True, settled=2.4)
    assert (settled.reached, settled.time, settled.entry_time) == (True, 2.4, pytest.approx(2.0))
    assert settled.success and not passing.success
    pressed = np.zeros((2000, 6))
    pressed[7, 2] = 10.1
    assert not measured(straight(), until_settled=True, settled=2.4, link_forces=pressed).success
