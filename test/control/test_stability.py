"""Gains that one period of delay would make unstable are refused or reduced."""

import pytest
from arm_simulation import ARM
from six_axis import SIX_AXIS

from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings, LimitSettings
from contact_reach_ros.control.stability import check_gains, spectral_radius
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.presets import check_parameters
from contact_reach_ros.resources import config_file

GAINS = ImpedanceSettings()


@pytest.mark.parametrize("stiffness", [0.0, 880.0, 2500.0])
@pytest.mark.parametrize("damping", [100.0, 300.0])
@pytest.mark.parametrize("period", [0.001, 0.01])
def test_the_radius_tells_whether_a_late_spring_and_damper_come_to_rest(stiffness, damping, period):
    position, speed, force = 1.0, 1.0, 0.0
    for _ in range(20000):
        acting, force = force, -stiffness * position - damping * speed
        position, speed = position + period * speed + 0.5 * period**2 * acting, speed + period * acting
        if abs(speed) > 1e6:
            break
    radius = spectral_radius(stiffness, damping, period)
    # Without a spring the mass rests anywhere: one eigenvalue is 1.
    assert (abs(speed) < 1e-3) == (radius < 1.0 or (stiffness == 0.0 and radius < 1.0 + 1e-9))


@pytest.mark.parametrize("rate", [125.0, 1000.0])
def test_the_papers_gains_are_stable_from_125_hz_on(rate):
    check_gains(SIX_AXIS, GAINS, 1.0 / rate)


@pytest.mark.parametrize("damping", [100.0, 150.0, 250.0])
@pytest.mark.parametrize("period", [0.001, 0.004, 0.005])
@pytest.mark.parametrize("delay", [0.0, 0.0013, 0.005, 0.0071, 0.01])
def test_the_radius_counts_parts_of_a_period(damping, period, delay):
    """Against steps of 0.1 ms."""
    stiffness, fine = 880.0, 1e-4
    position, speed, answers = 1.0, 0.0, []
    per_state, late = round(period / fine), round((period + delay) / fine)
    for step in range(round(20.0 / fine)):
        if step % per_state == 0:
            answers.append(-stiffness * position - damping * speed)
        answered = (step - late) // per_state
        force = answers[answered] if answered >= 0 else 0.0
        position, speed = position + fine * speed + 0.5 * fine**2 * force, speed + fine * force
        if abs(speed) > 1e6:
            break
    radius = spectral_radius(stiffness, damping, period, delay)
    assert (abs(speed) < 1e-3) == (radius < 1.0)


@pytest.mark.parametrize("arm", ["iiwa7", "iiwa14"])
@pytest.mark.parametrize("rate", [500.0, 1000.0])
def test_the_gains_behind_kukas_driver_are_stable_with_its_delay(arm, rate):
    given = {node: {"state_rate": rate} for node in ("driver", "controller", "observer", "planner")}
    check_parameters(config_file("lbr.yaml"), given, robot=arm)


@pytest.mark.parametrize(("delay", "is_stable"), [(0.01, True), (0.016, False), (0.03, False)])
def test_the_delay_of_the_drive_counts(delay, is_stable):
    """Damping of 100/s alone is stable with a delay of π/2 / 100 s."""
    assert (spectral_radius(0.0, 100.0, 0.001, delay) <= 1.0 + 1e-9) == is_stable
    late = LimitSettings(torque_delay=delay)
    if is_stable:
        Controller(ARM, ControllerSettings(limits=late), 0.001)
    else:
        with pytest.raises(SettingsError, match=f"not stable at 1000 Hz with {1e3 * (delay + 0.001):g} ms of delay"):
            Controller(ARM, ControllerSettings(limits=late), 0.001)


@pytest.mark.parametrize(
    ("gains", "rate", "message"),
    [
        (
            ImpedanceSettings(null_stiffness=15.0, null_damping=0.7),
            100.0,
            "task_stiffness = 880 and task_damping = 100 are not stable at 100 Hz with 10 ms of delay",
        ),
        (ImpedanceSettings(task_damping=300.0), 200.0, "task_damping = 300 are not stable at 200 Hz"),
        (ImpedanceSettings(null_damping=20.0), 1000.0, "null_damping = 20 are not stable at 1000 Hz"),
    ],
)
def test_gains_that_are_not_are_refused_with_the_largest_that_would_be(gains, rate, message):
    with pytest.raises(SettingsError, match=message) as refused:
        Controller(ARM, ControllerSettings(gains), 1.0 / rate)
    law = "task" if "task" in message else "null"
    words = str(refused.value).split("expected at most ")[1].split()
    stable = {f"{law}_stiffness": float(words[0]), f"{law}_damping": float(words[2])}
    check_gains(ARM, ImpedanceSettings(**{**vars(gains), **stable}), 1.0 / rate)
