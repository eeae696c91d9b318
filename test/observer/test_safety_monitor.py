"""Contact, and the stop above the contact budget: debounced, latched, reset only by a free arm at rest."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.arm import Arm, assumptions
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings
from contact_reach_ros.observer.safety import (
    HANDOVER_TIME,
    RELEASE_DEBOUNCE,
    SafetyLevel,
    SafetyMonitor,
    SafetySettings,
)
from contact_reach_ros.simulation.plant import TICK_NS, Actuation, Plant
from contact_reach_ros.world.scene import NO_MISMATCH, Scene

SETTINGS = SafetySettings()
MODEL = RobotModel(ARM)
# Nothing is too sudden, so that the other thresholds can be told apart.
BUDGET = ContactBudget(sudden_thresholds=(320.0,) * ARM.n).resolve(ARM)
THRESHOLDS = np.array(BUDGET.torque_thresholds)


@pytest.fixture
def monitor() -> SafetyMonitor:
    return SafetyMonitor(MODEL, SETTINGS, BUDGET)


def residual(joint: int, share: float) -> np.ndarray:
    """External torque on one joint as a share of its threshold."""
    return share * THRESHOLDS * np.eye(ARM.n)[joint]


def push(monitor: SafetyMonitor, torque: np.ndarray, count: int = SETTINGS.debounce, v: np.ndarray = REST) -> None:
    for _ in range(count):
        monitor.update(torque, HOME, v)


@given(st.lists(st.lists(st.floats(-1, 1), min_size=ARM.n, max_size=ARM.n), max_size=20))
def test_contact_within_the_budget_does_not_stop_the_arm(shares):
    monitor = SafetyMonitor(MODEL, SETTINGS, BUDGET)
    for share in shares:
        monitor.update(np.array(share) * THRESHOLDS, HOME, REST)
    assert not monitor.stopped


@pytest.mark.parametrize(("joint", "side"), [(joint, 1.01 * (-1.0) ** joint) for joint in range(ARM.n)])
def test_each_joint_has_its_threshold(monitor, joint, side):
    push(monitor, residual(joint, side))
    assert monitor.stop_reason.startswith(f"external torque on lbr_A{joint + 1} is ")
    assert monitor.stop_reason.endswith(f"permitted {THRESHOLDS[joint]:g} Nm")
    assert monitor.stops == 1


def test_short_peaks_are_ignored(monitor):
    for _ in range(10):
        push(monitor, residual(3, 5.0), SETTINGS.debounce - 1)
        push(monitor, residual(3, 0.9), 1)
    assert not monitor.stopped


def test_stop_is_latched_and_the_first_reason_kept(monitor):
    push(monitor, residual(2, 2.0))
    push(monitor, residual(5, 9.0), 50)
    monitor.stop("another")
    assert "lbr_A3" in monitor.stop_reason and monitor.stops == 1


@pytest.mark.parametrize(
    ("torque", "speed", "message"),
    [
        (0.0, -0.2, r"0\.200 rad/s; reset needs at most 0\.05 rad/s"),
        (-0.8, 0.0, r"lbr_A6 is -8\.0 Nm; reset needs at most 3 Nm: free the arm"),
    ],
)
def test_reset_of_a_moving_or_pushed_arm_is_refused(monitor, torque, speed, message):
    monitor.stop("test")
    push(monitor, residual(5, torque), 1, v=speed * np.eye(ARM.n)[3])
    with pytest.raises(InputError, match=message):
        monitor.reset()
    assert monitor.stop_reason == "test"


@pytest.mark.parametrize("joint", [1, 6])
def test_an_arm_that_was_reset_is_not_stopped_again_by_the_same_torque(joint):
    budget = ContactBudget().resolve(ARM)
    for torque in np.linspace(0.0, 30.0, 61):
        monitor = SafetyMonitor(MODEL, SETTINGS, budget)
        push(monitor, REST, 1)
        monitor.stop("test")
        push(monitor, torque * np.eye(ARM.n)[joint], 1)
        try:
            monitor.reset()
        except InputError:
            break
        push(monitor, torque * np.eye(ARM.n)[joint], 50)
        assert not monitor.stopped
    assert torque == pytest.approx(budget.handover_thresholds[joint], abs=0.6)


@pytest.mark.parametrize("joint", [1, 6])
def test_threshold_of_a_stop_grows_with_the_joints_speed(joint):
    speed = -0.8 * np.eye(ARM.n)[joint]
    allowed = THRESHOLDS + BUDGET.torque_per_speed[joint] * 0.8
    for share, stopped in ((0.99, False), (1.01, True)):
        monitor = SafetyMonitor(MODEL, SETTINGS, BUDGET)
        push(monitor, share * allowed * np.eye(ARM.n)[joint], v=speed)
        assert monitor.stopped is stopped
    at_rest = SafetyMonitor(MODEL, SETTINGS, BUDGET)
    push(at_rest, 0.99 * allowed * np.eye(ARM.n)[joint])
    assert at_rest.stopped


class TestContact:
    """Told above the thresholds of a contact, with debounce and hysteresis, and latched by nothing."""

    budget = ContactBudget().resolve(ARM)
    thresholds = np.array(budget.contact_thresholds)

    @pytest.fixture
    def monitor(self) -> SafetyMonitor:
        return SafetyMonitor(MODEL, SETTINGS, self.budget)

    def test_each_joint_has_its_threshold(self):
        for torque in np.diag((-1.0) ** np.arange(ARM.n) * self.thresholds):
            below, above = (SafetyMonitor(MODEL, SETTINGS, self.budget) for _ in range(2))
            push(below, 0.99 * torque, 50)
            assert below.level is SafetyLevel.FREE
            push(above, 1.1 * torque, SETTINGS.contact_debounce)
            assert above.level is SafetyLevel.CONTACT and not above.stopped

    def test_contact_ends_only_well_below_the_threshold_and_after_a_while(self, monitor):
        push(monitor, 1.5 * self.thresholds, 5)
        push(monitor, 0.9 * self.thresholds, 2 * RELEASE_DEBOUNCE)
        assert monitor.in_contact
        push(monitor, REST, RELEASE_DEBOUNCE - 1)
        assert monitor.in_contact
        push(monitor, REST, 1)
        assert monitor.level is SafetyLevel.FREE
        assert monitor.contacts == 1

    def test_sudden_torque_stops_below_the_threshold_of_a_slow_one(self):
        torque = 1.1 * np.array(self.budget.sudden_thresholds)[1] * np.eye(ARM.n)[1]
        assert torque[1] < self.budget.torque_thresholds[1]
        monitor = SafetyMonitor(MODEL, SETTINGS, self.budget)
        push(monitor, torque)
        assert monitor.level is SafetyLevel.COLLISION
        assert monitor.stop_reason.startswith("sudden external torque on lbr_A2 is 13.")
        assert monitor.stop_reason.endswith("permitted 12 Nm")


def test_weight_that_the_model_does_not_know_stops_the_arm_at_hand_over_and_is_named():
    budget = ContactBudget().resolve(ARM)
    monitor = SafetyMonitor(MODEL, SETTINGS, budget)
    for tick in range(round(HANDOVER_TIME * 1000)):
        monitor.update(1.1 * np.array(budget.handover_thresholds)[1] * np.eye(ARM.n)[1], HOME, REST, 1e-3 * tick)
    assert monitor.stop_reason.startswith("at hand-over the external torque on lbr_A2 is 11.0 Nm, permitted 10 Nm: ")
    # No compliant stop: the model that is wrong would have to carry the arm.
    assert monitor.distrust == monitor.stop_reason and monitor.stops == 1


@pytest.mark.parametrize(
    ("debounce", "period", "states"),
    [(1, 0.01, 1), (3, 0.001, 3), (3, 0.005, 2), (100, 0.001, 100), (100, 0.005, 20), (100, 0.01, 10)],
)
def test_a_debounce_lasts_as_long_at_every_rate_and_at_least_two_states(debounce, period, states):
    monitor = SafetyMonitor(MODEL, SafetySettings(debounce=debounce), BUDGET, period)
    push(monitor, 1.1 * THRESHOLDS, states - 1)
    assert not monitor.stopped
    push(monitor, 1.1 * THRESHOLDS, 1)
    assert monitor.stopped


def test_the_packages_file_says_what_the_code_says_and_another_replaces_what_it_names(tmp_path):
    assert load_budget() == ContactBudget()
    file = tmp_path / "budget.yaml"
    file.write_text("permitted_force: 4")
    assert load_budget(str(file)) == ContactBudget(permitted_force=4.0)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("permited_force: 4", "unknown key 'permited_force'"),
        ("handover_time: 0.3", "'handover_time' was removed in 0.3.0: leave it out; it is fixed at 0.3 s"),
        ("permitted_force: -1", "permitted_force = -1: expected"),
        ("torque_thresholds: [30, 30, 25, 25, 15, 10, 0]", "torque_thresholds = 0: expected"),
    ],
)
def test_file_and_key_are_named_when_it_is_refused(tmp_path, content, key):
    file = tmp_path / "budget.yaml"
    file.write_text(content)
    with pytest.raises(SettingsError, match=f"^{file}: {key}"):
        load_budget(file)


def test_thresholds_for_another_number_of_joints_are_refused_for_the_arm():
    with pytest.raises(SettingsError, match=r"torque_thresholds = .*: expected a list of 7 values"):
        ContactBudget(torque_thresholds=(30.0, 30.0, 25.0)).resolve(ARM)


def of_size(mass: float, effort: float) -> Arm:
    """The iiwa 14 with its masses and torque limits multiplied, and the thresholds of the rule."""
    inertias = tuple(
        dataclasses.replace(each, mass=mass * each.mass, tensor=tuple(mass * value for value in each.tensor))
        for each in ARM.inertias()
    )
    joints = tuple(dataclasses.replace(each, torque_limit=effort * each.torque_limit) for each in ARM.joints)
    arm = dataclasses.replace(ARM, joints=joints, inertia_sets={"nominal": inertias})
    return dataclasses.replace(arm, defaults=assumptions.defaults(arm))


@pytest.mark.parametrize(("mass", "effort"), [(300.0, 80.0), (0.03, 0.03)], ids=["heavy", "weak"])
def test_an_arm_of_any_size_that_nothing_touches_feels_no_contact(mass, effort):
    """It moves with the friction and the noise of its simulated drives."""
    arm = of_size(mass, effort)
    plant = Plant(Scene("test", arm, 0, HOME, np.zeros(3), (), mismatch=NO_MISMATCH))
    plant.set_actuation(Actuation.COMMANDED)
    model, observer = RobotModel(arm), MomentumObserver(MomentumSettings(), RobotModel(arm))
    monitor = SafetyMonitor(RobotModel(arm), SETTINGS, ContactBudget())
    observer.update(HOME, REST, None, 0)
    for tick in range(1500):
        q, v = plant.joint_positions, plant.data.qvel[: ARM.n].copy()
        model.update(q, v)
        time = max(tick - 500, 0) * 1e-3
        lag, slip = HOME + 0.1 * np.sin(time) - q, 0.1 * np.cos(time) - v
        plant.step(model.bias + np.diag(model.mass_matrix) * (100.0 * lag + 20.0 * slip))
        state = plant.read()
        residual = observer.update(state.q, state.v, state.torque, plant.steps * TICK_NS)
        monitor.update(residual, state.q, state.v, observer.known_for)
    assert (monitor.stop_reason, monitor.contacts) == ("", 0)
    assert (plant.joint_positions - HOME > 0.01).all()
