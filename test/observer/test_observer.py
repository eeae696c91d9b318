"""The observer as one object: which states it takes, in which order, and when its reports are due."""

import math

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS

from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import StopCode
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.observer.observer import HEARTBEAT, Observer, SafetyReport
from contact_reach_ros.observer.safety import HANDOVER_TIME, SafetyLevel
from contact_reach_ros.observer.settings import MomentumSettings, ObserverSettings
from contact_reach_ros.observer.sight import STILL

BUDGET = ContactBudget().resolve(ARM)
GRAVITY = RobotModel(ARM).gravity_at(HOME)
UNKNOWN = np.full(ARM.n, math.nan)
HANDED_OVER = round(1000 * HANDOVER_TIME) + 10
HARD = np.where(np.arange(ARM.n) == 1, 60.0, 0.0)
SOFT = np.where(np.arange(ARM.n) == 3, 6.0, 0.0)


class Watched:
    """An arm at rest whose brakes open at once, and its observer."""

    def __init__(self, period_ms: int = 1, **settings) -> None:
        self.observer = Observer(ARM, ObserverSettings(**settings), BUDGET, 0.001 * period_ms)
        self.period_ms = period_ms
        self.tick = 0
        self._random = np.random.default_rng(0)

    def state(self, external: np.ndarray = REST, **changes) -> JointState:
        """The next state, with an external torque that the brakes of no joint take up."""
        self.tick += self.period_ms
        q = HOME + 1e-6 * self._random.standard_normal(ARM.n)
        return JointState(self.tick * TICK_NS, q, REST, GRAVITY - external)._replace(**changes)

    def run(self, count: int, external: np.ndarray = REST) -> list[SafetyReport]:
        return [self.observer.update(self.state(external)) for _ in range(count)]


@pytest.fixture
def watched() -> Watched:
    """After the hand-over, with nothing that touches the arm."""
    watched = Watched()
    watched.run(HANDED_OVER)
    return watched


class TestOrder:
    @pytest.mark.parametrize(("back", "repeated", "older"), [(0, 1, 0), (1, 0, 1), (1000, 0, 1)])
    def test_a_state_that_comes_again_or_late_changes_nothing(self, watched, back, repeated, older):
        observer, residual = watched.observer, watched.observer.momentum.residual.copy()
        again = JointState((watched.tick - back) * TICK_NS, HOME, REST, GRAVITY - HARD)
        assert observer.update(again) is None
        np.testing.assert_array_equal(observer.momentum.residual, residual)
        assert (observer.updates, observer.momentum.gaps) == (HANDED_OVER, 0)
        assert (observer.order.repeated, observer.order.older) == (repeated, older)


class TestDue:
    def test_the_first_report_is_news_and_the_first_that_vouches_for_the_arm(self):
        first, second, third = Watched().run(3)
        assert first.has_news and first.due and first.verdict.doubt and first.age == math.inf
        assert second.due and not second.verdict.doubt and second.age == 0.0
        assert not third.due

    @pytest.mark.parametrize("period_ms", [1, 5, 20])
    def test_a_sign_of_life_is_due_every_ten_milliseconds(self, period_ms):
        watched = Watched(period_ms)
        reports = watched.run(100)
        every = max(1, round(1000 * HEARTBEAT) // period_ms)
        # Nothing else is due but the first, which is news, and the second, which vouches for the arm.
        due = sorted({1, 2, *range(every, 101, every)})
        assert [number for number, report in enumerate(reports, 1) if report.due] == due

    def test_the_contact_is_located_at_each_sign_of_life_and_forgotten_with_its_end(self, watched):
        reports = watched.run(100, SOFT)
        contacts = {id(report.contact): report.contact for report in reports if report.contact is not None}
        assert 9 <= len(contacts) <= 10
        assert watched.run(300)[-1].contact is None

    @pytest.mark.parametrize(("least", "claimed"), [(12.0, False), (14.0, True)])
    def test_a_contact_is_excessive_where_no_weaker_force_explains_it(self, watched, monkeypatch, least, claimed):
        contact = Contact(ARM.link_names[-1], np.zeros(3), np.array([0.0, 0.0, -20.0]), SOFT, least=least)
        monkeypatch.setattr(watched.observer, "locate", lambda q: contact)
        assert BUDGET.permitted_force + 3.0 == 13.0
        assert not watched.run(150, SOFT)[-1].verdict.excess
        assert watched.run(150, SOFT)[-1].verdict.excess == claimed

    def test_what_the_baseline_has_absorbed_of_a_contact_is_no_strong_contact_when_it_has_ended(self):
        """A touch of 11 N at the wrist that grows over 3 s while the arm moves."""
        watched, model = Watched(), RobotModel(ARM).pinocchio
        data, random = model.createData(), np.random.default_rng(0)
        start = HOME + np.array([0.0, -0.7, 0.9, 0.6, 0.0, 0.0, 0.0])
        pin.computeJointJacobians(model, data, HOME)
        touch = pin.getJointJacobian(model, data, 6, pin.LOCAL_WORLD_ALIGNED)[:3].T @ [0.0, 4.0, -10.0]
        # The way home takes 3 s, after the hand-over.
        for turn in np.pi * np.clip(np.arange(-HANDED_OVER, 3000) / 3000, 0.0, 1.0):
            share, rate, way = 0.5 * (1.0 - np.cos(turn)), np.pi / 3.0, HOME - start
            q = start + share * way + 1e-6 * random.standard_normal(ARM.n)
            v, a = 0.5 * rate * np.sin(turn) * way, 0.5 * rate**2 * np.cos(turn) * (turn > 0.0) * way
            torque = pin.rnea(model, data, q, v, a) - turn / np.pi * touch
            watched.observer.update(watched.state(q=q, v=v, torque=torque))
        watched.run(300, touch)
        assert np.abs(touch - watched.observer.monitor.sudden).max() > 2.0
        watched.run(300)
        contact = watched.observer.contact
        assert contact.strength > 5.0
        assert contact.least < 1.0


BLIND_MS = 250
"""Time without a usable state after which the observer is blind."""


class TestTorque:
    """Either all joints' torques are known, or none."""

    @pytest.mark.parametrize(("joint", "value"), [(0, math.nan), (3, math.inf), (6, -math.inf)])
    def test_torques_of_some_joints_only_leave_the_residual_and_soon_make_it_blind(self, watched, joint, value):
        torque = np.where(np.arange(ARM.n) == joint, value, GRAVITY)
        momentum = watched.observer.momentum
        residual, known_for = momentum.residual.copy(), momentum.known_for
        reports = [watched.observer.update(watched.state(torque=torque)) for _ in range(BLIND_MS + 1)]
        np.testing.assert_array_equal(momentum.residual, residual)
        # The hand-over does not begin again.
        assert (momentum.known_for, momentum.refused) == (known_for, BLIND_MS + 1)
        assert [report.level for report in reports] == [SafetyLevel.FREE] * BLIND_MS + [SafetyLevel.BLIND]
        assert reports[-1].due and reports[-1].verdict.reason == reports[-1].verdict.doubt
        assert f"blind: joint_states carry no finite effort for {ARM.joint_names[joint]}" in reports[-1].verdict.reason
        assert reports[-1].verdict.reason.code is StopCode.BLIND
        assert reports[-1].age == pytest.approx(0.001 * (BLIND_MS + 1))
        assert watched.run(2)[-1].level is SafetyLevel.FREE

    def test_joint_states_without_efforts_make_it_blind(self, watched):
        for _ in range(BLIND_MS + 1):
            report = watched.observer.update(watched.state(torque=None))
        assert "blind: joint_states carry no effort" in report.verdict.reason

    def test_brakes_may_hide_the_torques_of_an_arm_at_rest_for_ever(self, watched):
        for _ in range(1000):
            report = watched.observer.update(watched.state(torque=UNKNOWN))
        assert (report.level, report.verdict.reason, report.verdict.doubt) == (SafetyLevel.FREE, "", "")
        assert not report.verdict.torque_known

    def test_a_moving_arm_without_torques_is_given_to_its_drive_for_a_while_only(self, watched):
        speed = np.where(np.arange(ARM.n) == 2, 0.3, 0.0)
        reports = []
        for _ in range(BLIND_MS + 1):
            q = HOME + 0.001 * speed * (len(reports) + 1)
            reports.append(watched.observer.update(watched.state(torque=UNKNOWN, q=q, v=speed)))
        assert [report.level for report in reports] == [SafetyLevel.FREE] * BLIND_MS + [SafetyLevel.BLIND]
        assert "no torque is known while the arm moves" in reports[-1].verdict.reason
        # Each new reason is published, logged and recorded.
        assert len({report.verdict.reason for report in reports if report.verdict.reason}) == 1


def test_a_push_within_the_budget_is_a_contact_and_a_hard_one_a_stop_at_another_rate():
    watched = Watched(5)
    watched.run(HANDED_OVER // 5 + 1)
    assert watched.run(20, SOFT)[-1].level is SafetyLevel.CONTACT
    assert watched.run(100)[-1].level is SafetyLevel.FREE
    assert watched.run(20, HARD)[-1].level is SafetyLevel.COLLISION


@pytest.mark.parametrize("period_ms", [4, 50])
def test_states_that_come_too_seldom_make_it_blind_and_the_rate_is_named(period_ms):
    """Three periods of the nominal rate are the longest step over which an external torque can be had."""
    watched = Watched()
    watched.period_ms = period_ms
    reports = watched.run(200)
    assert reports[0].verdict.doubt and not reports[0].verdict.reason
    for report in reports[BLIND_MS // period_ms + 2 :]:
        assert report.level is SafetyLevel.BLIND
        assert (
            f"joint states come at {1000 / period_ms:.0f} Hz, expected 1000 Hz: set the parameter state_rate"
            in report.verdict.reason
        )


def test_another_rate_that_can_be_watched_keeps_the_arm_from_being_started_but_does_not_stop_it():
    watched = Watched()
    watched.period_ms = 2
    assert not watched.run(4)[-1].verdict.doubt
    report = watched.run(40)[-1]
    assert report.level is SafetyLevel.FREE and not report.verdict.reason
    assert "joint states come at 500 Hz, expected 1000 Hz" in report.verdict.doubt


@pytest.mark.parametrize("before", [0, 1, HANDED_OVER])
def test_stamps_that_stop_make_it_blind_and_ones_that_go_on_make_it_see(before):
    watched = Watched()
    watched.run(before)
    state = watched.state()
    watched.observer.update(state)
    reports = [watched.observer.update(state) for _ in range(STILL)]
    assert reports[:-1] == [None] * (STILL - 1)
    assert reports[-1].due and "the stamps of joint_states do not advance" in reports[-1].verdict.reason
    assert not watched.run(1)[0].verdict.reason


def test_stamps_that_go_in_a_circle_make_it_blind():
    """A clock that is set back again and again does not undo the time without an external torque."""
    watched, seen = Watched(), []
    watched.run(HANDED_OVER)
    state = watched.state()
    for tick in range(100):
        stamp_ns = state.stamp_ns + 4 * TICK_NS * (tick % 16 + 1)
        q = state.q + 1e-7 * (-1.0) ** tick
        seen.append(watched.observer.update(state._replace(stamp_ns=stamp_ns, q=q)))
    reasons = [report.verdict.reason for report in seen if report is not None]
    assert not reasons[10] and "blind" in reasons[-1]


SHIFTS = {
    "center_shift_x": (0.0, 0.01, 0.0, 0.0, 0.02, 0.0, 0.0),
    "center_shift_y": (0.0, -0.05, 0.0, -0.07, 0.0, 0.0, 0.0),
}
OFFSETS = (0.5, -0.4, 0.3, -0.2, 0.1, 0.2, -0.3)


def test_weights_and_offsets_that_were_identified_are_no_external_torque():
    shifted = RobotModel(ARM.with_center_shifts(**{name[-1]: values for name, values in SHIFTS.items()}))
    lacking = GRAVITY - shifted.gravity_at(HOME)
    assert np.abs(lacking).max() > 3.0
    plain = Watched()
    report = plain.run(HANDED_OVER, lacking - OFFSETS)[-1]
    np.testing.assert_allclose(report.residual, lacking - OFFSETS, atol=0.05)
    known = Watched(momentum=MomentumSettings(torque_offset=OFFSETS, **SHIFTS))
    report = known.run(HANDED_OVER, lacking - OFFSETS)[-1]
    np.testing.assert_allclose(report.residual, 0.0, atol=0.05)


@pytest.mark.parametrize("torque", [{}, {"torque": np.full(7, np.nan)}], ids=["known", "behind brakes"])
def test_states_of_a_joint_state_publisher_do_not_start_an_arm_and_the_remapping_is_named(torque):
    watched = Watched(period_ms=33)
    observer = Observer(ARM, ObserverSettings(), BUDGET, 0.001)
    for number in range(60):
        report = observer.update(watched.state()._replace(**torque))
        assert report is None or number < 6 or report.verdict.doubt
    assert "come at 30 Hz, expected 1000 Hz" in report.verdict.doubt and "franka/joint_states" in report.verdict.doubt
