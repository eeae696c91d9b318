"""What is attributed to the model is bounded, and changes with the posture only."""

import math

import numpy as np
import pytest

from contact_reach_ros.observer.safety import ModelError

BOUND, PER_RAD, AT_REST = 8.0, 6.0, 0.5
STATES = 100
HANDED_OVER = 2.0


@pytest.fixture
def error() -> ModelError:
    """Two joints, handed over with a torque on the first."""
    error = ModelError([BOUND] * 2, [PER_RAD] * 2, [AT_REST] * 2)
    error.restart([HANDED_OVER, 0.0], [0.0, 0.0])
    return error


def follow(error: ModelError, torque: float, travelled: float = 0.0, states: int = 20 * STATES) -> float:
    """The mean on the first joint after so long, over which the second joint moves."""
    for angle in np.linspace(error._posture[1], error._posture[1] + travelled, states):
        error.follow([torque, 0.0], [0.0, float(angle)], STATES)
    assert error.mean[1] == 0.0
    return error.mean[0]


@pytest.mark.parametrize("torque", [50.0, -50.0, HANDED_OVER + 0.3])
def test_at_rest_it_takes_up_friction_and_no_more(error, torque):
    expected = min(max(torque, HANDED_OVER - AT_REST), HANDED_OVER + AT_REST)
    assert follow(error, torque) == pytest.approx(expected, abs=1e-6)


def test_noise_of_encoders_is_no_motion(error):
    random = np.random.default_rng(0)
    for noise in 1e-4 * random.standard_normal((20 * STATES, 2)):
        error.follow([50.0, 0.0], noise.tolist(), STATES)
    assert error.mean[0] == pytest.approx(HANDED_OVER + AT_REST)


@pytest.mark.parametrize("travelled", [0.1, 0.5, -0.5])
def test_in_motion_it_changes_with_the_distance(error, travelled):
    gained = follow(error, 50.0, travelled) - HANDED_OVER - AT_REST
    assert gained == pytest.approx(PER_RAD * abs(travelled), rel=0.15)
    # And then stays, however long.
    assert follow(error, 50.0) == pytest.approx(HANDED_OVER + AT_REST + gained, abs=PER_RAD * 0.02)


def test_a_restart_forgets_what_was_before_within_the_bounds_and_what_is_no_number_leaves_no_trace(error):
    error.restart([100.0, -1.0], [3.0, 0.0])
    error.follow([math.nan, 1.0], [1.0, 0.0], STATES)
    assert error.mean == [BOUND, -1.0]
    for _ in range(20 * STATES):
        error.follow([0.0, 0.0], [3.0, 0.0], STATES)
    assert error.mean == pytest.approx([BOUND - AT_REST, -1.0 + AT_REST])
