"""States come in order or not, the controller starts with the first, and answers each once."""

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, SECOND_NS, TICK_NS, UNWATCHED, references_of

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.kinematics import rotation_about
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.references import Reference, References
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, Verdict

SETTINGS = UNWATCHED
GRAVITY = RobotModel(ARM).gravity_at(HOME)
STEP = torque_rates(ARM, SETTINGS.limits) * TICK_NS / SECOND_NS


def state(tick: int, q: np.ndarray = HOME, v: np.ndarray = REST) -> JointState:
    return JointState(tick * TICK_NS, q, v, None)


def update(controller: Controller, given: JointState) -> np.ndarray | None:
    return controller.update(given, given.stamp_ns)


def plan(stamp_ns: int, offset: float = 0.01) -> References:
    """Of 0.1 s, beside the home pose."""
    position, rotation = RobotModel(ARM).tip_pose(HOME)
    return references_of([Reference(position + offset, rotation, HOME)], stamp_ns, (SECOND_NS // 10,))


@pytest.fixture
def controller() -> Controller:
    return Controller(ARM, SETTINGS)


@pytest.fixture
def holding(controller) -> Controller:
    """A controller that has answered the states of ticks 0 to 9."""
    for tick in range(10):
        update(controller, state(tick))
    return controller


def test_the_first_state_starts_it_with_the_torque_that_holds_the_arm(controller):
    first = state(5)
    assert (controller.started, controller.state, controller.mode) == (False, None, Mode.WAITING)
    np.testing.assert_allclose(update(controller, first), GRAVITY, rtol=0, atol=1e-9)
    assert (controller.started, controller.mode) == (True, Mode.HOLDING)
    assert controller.state is first


@pytest.mark.parametrize(("tick", "repeated", "older"), [(9, 1, 0), (8, 0, 1), (-1000, 0, 1)])
def test_a_state_that_comes_again_or_late_has_no_answer_and_leaves_no_trace(holding, tick, repeated, older):
    answered = holding.state
    assert update(holding, state(tick, HOME + 0.1, REST + 1.0)) is None
    assert holding.state is answered
    assert (holding.order.repeated, holding.order.older) == (repeated, older)
    np.testing.assert_allclose(update(holding, state(10)), GRAVITY, rtol=0, atol=1e-6)


def test_after_a_clock_was_set_back_states_are_answered_again(holding):
    answers = [update(holding, state(tick - 5000)) for tick in range(20)]
    missed = [tick for tick, answer in enumerate(answers) if answer is None]
    assert missed == list(range(len(missed))) and 0 < len(missed) < 10
    assert holding.mode is Mode.HOLDING


class TestNotYet:
    """Others command the arm, so nothing is commanded yet."""

    def test_the_start_is_refused_for_as_long(self, controller):
        controller.not_yet = "somebody else commands the arm"
        for tick in range(5):
            with pytest.raises(InputError, match="somebody else commands the arm; nothing is commanded"):
                update(controller, state(tick))
        assert (controller.started, controller.state, controller.mode) == (False, None, Mode.WAITING)
        controller.not_yet = ""
        np.testing.assert_allclose(update(controller, state(5)), GRAVITY, rtol=0, atol=1e-9)


class TestActivate:
    def test_the_next_state_starts_again_whatever_its_stamp(self, holding):
        holding.follow(plan(9 * TICK_NS))
        for tick in range(10, 30):
            update(holding, state(tick))
        assert holding.mode is Mode.TRACKING
        holding.activate()
        assert not holding.started
        elsewhere = HOME + 0.1
        torque = update(holding, state(0, elsewhere))
        np.testing.assert_allclose(torque, RobotModel(ARM).gravity_at(elsewhere), rtol=0, atol=1e-9)
        assert holding.mode is Mode.HOLDING
        np.testing.assert_allclose(holding.error, 0, atol=1e-9)

    def test_a_stop_stays(self, holding):
        holding.stop("pushed")
        holding.activate()
        update(holding, state(10))
        assert (holding.mode, holding.stop_reason) == (Mode.STOPPED, "pushed")

    def test_an_arm_outside_its_limits_is_not_started(self, holding):
        holding.activate()
        beyond = np.where(np.arange(ARM.n) == 1, ARM.upper + 0.01, HOME)
        with pytest.raises(InputError, match=f"{ARM.joint_names[1]} beyond the position limit"):
            update(holding, state(10, beyond))
        assert not holding.started
        assert update(holding, state(11)) is not None


class TestReset:
    def test_the_arm_is_held_in_the_last_state(self, holding):
        holding.stop("test")
        elsewhere = HOME + 0.2
        for tick in range(10, 60):
            update(holding, state(tick, elsewhere))
        holding.reset(60 * TICK_NS)
        assert (holding.mode, holding.stop_reason) == (Mode.HOLDING, "")
        update(holding, state(60, elsewhere))
        np.testing.assert_allclose(holding.error, 0, atol=1e-9)


class TestVouching:
    """Nothing is commanded until the observer has vouched for the states."""

    @pytest.fixture
    def controller(self) -> Controller:
        return Controller(ARM, ControllerSettings())

    def test_nothing_is_commanded_before_the_observer_is_heard(self, controller):
        assert all(update(controller, state(tick)) is None for tick in range(1, 100))
        assert "nothing heard from the observer yet" in controller.not_vouched
        assert not controller.started and controller.mode is Mode.WAITING

    def test_its_first_report_that_doubts_nothing_starts_the_arm(self, controller):
        for tick, verdict in enumerate((Verdict(doubt="first states"), Verdict("blind: ..."), Verdict()), 1):
            controller.hear(verdict, tick * TICK_NS)
            torque = update(controller, state(tick))
            assert (torque is None) == bool(verdict.reason or verdict.doubt)
        assert controller.started and not controller.not_vouched

    def test_blindness_stops_the_arm_and_has_to_be_over_before_a_reset(self, controller):
        controller.hear(Verdict(), TICK_NS)
        update(controller, state(1))
        controller.hear(Verdict("blind: no effort"), TICK_NS)
        assert (controller.mode, controller.stop_reason) == (Mode.STOPPED, "blind: no effort")
        with pytest.raises(InputError, match="the observer is stopped"):
            controller.reset(2 * TICK_NS)
        controller.hear(Verdict(), 2 * TICK_NS)
        controller.reset(2 * TICK_NS)
        assert controller.mode is Mode.HOLDING

    def test_plans_wait_for_known_torques(self, controller):
        controller.hear(Verdict(torque_known=False), TICK_NS)
        update(controller, state(1))
        controller.follow(plan(TICK_NS))
        update(controller, state(2))
        assert controller.mode is Mode.HOLDING
        controller.hear(Verdict(), 2 * TICK_NS)
        update(controller, state(3))
        assert controller.mode is Mode.TRACKING

    @pytest.mark.parametrize("period_ms", [1, 5, 10])
    def test_a_dead_observer_is_noticed_at_every_rate_however_long_the_pauses_between_states(self, period_ms):
        """Pauses of the controller's own are forgiven once, not each time."""
        controller = Controller(ARM, ControllerSettings())
        controller.hear(Verdict(), TICK_NS)
        tick = 1
        while not controller.stop_reason:
            update(controller, state(tick))
            tick += period_ms
        assert controller.stop_reason.startswith("observer silent")
        assert tick <= 60 + 3 * period_ms


class TestPause:
    """After joint states paused the arm may be anywhere, and so may what holds it."""

    ELSEWHERE = HOME + np.array([0.3, -0.2, 0.1, 0.2, 0.0, 0.0, 0.0])

    def show(self, controller: Controller, stamp_ns: int) -> np.ndarray:
        return controller.update(JointState(stamp_ns, self.ELSEWHERE, REST, None), stamp_ns)

    @pytest.mark.parametrize("has_plan", [False, True])
    def test_the_hold_is_taken_anew_and_authority_ramps(self, holding, has_plan):
        if has_plan:
            holding.follow(references_of([Reference(*RobotModel(ARM).tip_pose(HOME), HOME)], 9 * TICK_NS, (SECOND_NS,)))
            update(holding, state(10))
            assert holding.mode is Mode.TRACKING
        weight = RobotModel(ARM).gravity_at(self.ELSEWHERE)
        torques = [self.show(holding, SECOND_NS // 2 + tick * TICK_NS) for tick in range(1000)]
        assert holding.mode is Mode.HOLDING
        # An arm at rest where it was put stays there: no torque pulls it back to where it was.
        np.testing.assert_allclose(torques, np.tile(weight, (1000, 1)), rtol=0, atol=1e-6)


class TestBounds:
    """References that are too far from the arm are not followed."""

    @pytest.fixture
    def task(self) -> str:
        return "pose"

    @pytest.fixture
    def holding(self, task) -> Controller:
        controller = Controller(ARM, ControllerSettings(impedance=ImpedanceSettings(task=task)))
        for tick in range(1, 10):
            controller.hear(Verdict(), tick * TICK_NS)
            update(controller, state(tick))
        return controller

    def offered(self, controller: Controller, change: Reference, ends_ns: int = SECOND_NS // 10) -> str:
        """Why a plan of one reference is dropped, empty if it is followed."""
        controller.follow(references_of([change], 10 * TICK_NS, (ends_ns,)))
        update(controller, state(10))
        assert (controller.mode is Mode.TRACKING) == (not controller.references.dropped)
        return "; ".join(controller.references.dropped)

    @pytest.mark.parametrize("distance", [0.051, 1.0])
    def test_a_position_that_is_too_far_is_dropped_with_both_distances(self, holding, distance):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(position + np.array([0.0, distance, 0.0]), rotation, HOME))
        assert f"x_d is {distance:.3f} m from the tip, permitted 0.05 m (max_position_error)" in found

    @pytest.mark.parametrize("task", ["position_and_axis"])
    @pytest.mark.parametrize(("axis", "dropped"), [([0.0, 0.0, 1.0], False), ([1.0, 0.0, 0.0], True)])
    def test_only_the_axis_counts_where_law_one_controls_no_more(self, holding, axis, dropped):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(position, rotation @ rotation_about(axis, 1.0), HOME))
        assert ("x_d is turned by 1.00 rad" in found) == dropped

    @pytest.mark.parametrize("joint", range(ARM.n))
    def test_so_is_a_posture_and_the_joint_is_named(self, holding, joint):
        pose = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(*pose, HOME + 0.6 * np.eye(ARM.n)[joint]))
        assert f"q_d is 0.60 rad from {ARM.joint_names[joint]}, permitted 0.5 rad" in found

    def test_a_plan_that_lasts_too_long_is_refused(self, holding):
        with pytest.raises(InputError, match="the plan lasts 2 s; expected at most 1 s"):
            self.offered(holding, Reference(*RobotModel(ARM).tip_pose(HOME), HOME), 2 * SECOND_NS)

    @pytest.mark.parametrize(
        ("axis", "past", "message"),
        [(0, -2.1, "x of x_d is -2.100 m"), (2, -2.1, "z of x_d is -2.100 m"), (2, 2.1, "z of x_d is 2.100 m")],
    )
    def test_a_plan_is_dropped_where_it_leaves_the_workspace(self, holding, axis, past, message):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        position[axis] = past
        assert f"{message}, permitted " in self.offered(holding, Reference(position, rotation, HOME))
        assert holding.mode is Mode.HOLDING
