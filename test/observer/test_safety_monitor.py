"""The stop above the contact budget: debounced, latched, reset only by an arm that is free and at rest."""

import math

import numpy as np
import pytest
from arm_simulation import REST
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.safety import SafetyMonitor, SafetySettings

SETTINGS = SafetySettings()
BUDGET = ContactBudget()
THRESHOLDS = np.array(BUDGET.torque_thresholds)


@pytest.fixture
def monitor() -> SafetyMonitor:
    return SafetyMonitor(SETTINGS, BUDGET)


def residual(joint: int, share: float) -> np.ndarray:
    """External torque on one joint as a share of its threshold."""
    return share * THRESHOLDS * np.eye(7)[joint]


def push(monitor: SafetyMonitor, torque: np.ndarray, count: int = SETTINGS.debounce, v: np.ndarray = REST) -> None:
    for _ in range(count):
        monitor.update(torque, v)


@given(st.lists(st.lists(st.floats(-1, 1), min_size=7, max_size=7), max_size=20))
def test_contact_within_the_budget_does_not_stop_the_arm(shares):
    monitor = SafetyMonitor(SETTINGS, BUDGET)
    for share in shares:
        monitor.update(np.array(share) * THRESHOLDS, REST)
    assert not monitor.stopped


@pytest.mark.parametrize("side", [-1.01, 1.01])
@pytest.mark.parametrize("joint", range(7))
def test_each_joint_has_its_threshold(monitor, joint, side):
    push(monitor, residual(joint, side))
    assert monitor.stopped
    assert monitor.stop_reason.startswith(f"external torque on lbr_A{joint + 1} is ")
    assert monitor.stop_reason.endswith(f"permitted {THRESHOLDS[joint]:g} Nm")
    assert monitor.stops == 1


def test_short_peaks_are_ignored(monitor):
    for _ in range(10):
        push(monitor, residual(3, 5.0), SETTINGS.debounce - 1)
        push(monitor, residual(3, 0.9), 1)
    assert not monitor.stopped
    push(monitor, residual(3, 5.0))
    assert monitor.stopped


def test_peaks_of_different_joints_count_together(monitor):
    for joint in range(SETTINGS.debounce):
        push(monitor, residual(joint, 1.5), 1)
    assert monitor.stopped


def test_stop_is_latched_and_the_first_reason_kept(monitor):
    push(monitor, residual(2, 2.0))
    reason = monitor.stop_reason
    push(monitor, residual(5, 9.0), 50)
    push(monitor, REST, 50)
    monitor.stop("another")
    assert monitor.stop_reason == reason
    assert monitor.stops == 1


def test_residual_that_is_not_a_number_stops_the_arm_and_stays(monitor):
    push(monitor, np.full(7, math.nan))
    assert monitor.stopped
    with pytest.raises(InputError, match="external torque on lbr_A1 is nan"):
        monitor.reset()
    assert monitor.stopped


def test_reset_of_a_free_arm_at_rest(monitor):
    push(monitor, residual(2, 2.0))
    push(monitor, residual(2, 0.9 * SETTINGS.reset_share), 1)
    monitor.reset()
    assert not monitor.stopped
    push(monitor, residual(2, 2.0), SETTINGS.debounce - 1)
    assert not monitor.stopped
    push(monitor, residual(2, 2.0), 1)
    assert monitor.stops == 2


def test_reset_of_a_moving_arm_is_refused(monitor):
    monitor.stop("test")
    push(monitor, REST, 1, v=np.array([0, 0, 0, -0.2, 0, 0, 0]))
    with pytest.raises(InputError, match=r"0\.200 rad/s; reset needs at most 0\.05 rad/s"):
        monitor.reset()
    assert monitor.stop_reason == "test"


def test_reset_of_a_pushed_arm_is_refused_and_the_joint_named(monitor):
    monitor.stop("test")
    push(monitor, residual(5, -0.8), 1)
    with pytest.raises(InputError, match=r"lbr_A6 is -8\.0 Nm; reset needs at most 5 Nm: free the arm"):
        monitor.reset()
    assert monitor.stop_reason == "test"
