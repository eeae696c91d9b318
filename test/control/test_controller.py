"""What the controller does about plans, states, observer and stops, without a simulated arm; each state once."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, SECOND_NS, TICK_NS, UNWATCHED, offer_plan, patient_controller, references_of

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.kinematics import rotation_about
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import HOLD_BLEND, START_RAMP, Controller, ControllerSettings
from contact_reach_ros.control.references import Reference, References
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, Verdict

SETTINGS = UNWATCHED
RAMP_TICKS = round(1000 * SETTINGS.impedance.reference_ramp)
PLAN_NS = SECOND_NS // 10
GRAVITY = RobotModel(ARM).gravity_at(HOME)
STEP = torque_rates(ARM, SETTINGS.limits) * TICK_NS / SECOND_NS


class Bench:
    """A controller that is shown states at 1 kHz."""

    def __init__(self, settings: ControllerSettings = SETTINGS) -> None:
        self.controller = patient_controller(settings)
        self.now_ns = 0
        self.torque = REST

    def start(self, q: np.ndarray = HOME, v: np.ndarray = REST) -> "Bench":
        self.controller.start(q, v, self.now_ns)
        return self

    def tick(self, q: np.ndarray = HOME, v: np.ndarray = REST, count: int = 1) -> np.ndarray:
        for _ in range(count):
            state = JointState(self.now_ns, q, v, None)
            self.now_ns += TICK_NS
            self.torque = self.controller.update(state, state.stamp_ns)
        return self.torque

    def reference(self, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Reference:
        position, rotation = self.controller.model.tip_pose(HOME)
        return Reference(position + offset, rotation, HOME)

    def plan(self, *offsets: tuple[float, float, float], stamp_ns: int | None = None) -> None:
        """Offer a plan of 0.1 s for each offset from the home pose."""
        ends = tuple(PLAN_NS * (index + 1) for index in range(len(offsets)))
        stamp = self.now_ns if stamp_ns is None else stamp_ns
        offer_plan(self.controller, [self.reference(offset) for offset in offsets], stamp, ends, self.now_ns)

    def reset(self, q: np.ndarray = HOME, v: np.ndarray = REST) -> None:
        """Reset the arm in the state that comes next."""
        self.tick(q, v)
        self.controller.reset(self.now_ns)


@pytest.fixture
def bench() -> Bench:
    return Bench().start()


class TestStart:
    def test_first_command_of_an_arm_that_compensates_gravity_itself_is_zero(self):
        settings = ControllerSettings(supervision=SupervisionSettings(gravity_compensation=False))
        np.testing.assert_array_equal(Bench(settings).start().tick(), 0)

    def test_authority_ramps_in(self):
        steps = dataclasses.replace(SETTINGS, impedance=ImpedanceSettings(reference_ramp=0.0))
        bench = Bench(steps).start()
        bench.plan((0.002, 0.0, 0.0), (0.002, 0.0, 0.0), (0.002, 0.0, 0.0), (0.002, 0.0, 0.0))
        pulls = [np.linalg.norm(bench.tick() - GRAVITY) for _ in range(400)]
        ramp = START_RAMP
        np.testing.assert_allclose(pulls, np.arange(400) * 1e-3 / ramp * pulls[-1] / (0.399 / ramp), atol=1e-9)


class TestPlans:
    def test_plan_is_tracked_from_its_stamp_to_its_last_knot(self, bench):
        bench.plan((0.01, 0.0, 0.0), (0.02, 0.0, 0.0), stamp_ns=PLAN_NS)
        seen = []
        for _ in range(400):
            bench.tick()
            seen.append((bench.controller.mode, -bench.controller.error[0]))
        modes = [mode for mode, _ in seen]
        assert set(modes[:100]) == {Mode.HOLDING}
        assert set(modes[100:300]) == {Mode.TRACKING}
        assert set(modes[300:]) == {Mode.HOLDING}
        moved = 0.01 * np.minimum(np.arange(100) / RAMP_TICKS, 1.0)
        np.testing.assert_allclose([error for _, error in seen[100:200]], moved, atol=1e-9)
        np.testing.assert_allclose([error for _, error in seen[200:300]], 0.01 + moved, atol=1e-9)

    def test_a_plan_takes_over_from_one_whose_knot_was_not_reached_yet(self, bench):
        bench.plan((0.02, 0.0, 0.0))
        bench.tick(count=RAMP_TICKS // 2 + 1)
        bench.plan((0.0, 0.0, 0.0))
        errors = []
        for _ in range(RAMP_TICKS + 1):
            bench.tick()
            errors.append(-bench.controller.error[0])
        np.testing.assert_allclose(errors, np.linspace(0.01, 0.0, RAMP_TICKS + 1), atol=1e-9)

    def test_reference_decays_to_the_pose_at_hand_after_the_last_knot(self, bench):
        bench.plan((0.03, 0.0, 0.0))
        bench.tick(count=100)
        errors = []
        for _ in range(400):
            bench.tick()
            errors.append(-bench.controller.error[0])
        blend = HOLD_BLEND
        expected = np.maximum(0.03 * (1 - np.arange(400) * 1e-3 / blend), 0)
        np.testing.assert_allclose(errors, expected, atol=1e-9)

    def test_no_plan_for_too_long_after_one_stops_the_arm(self):
        bench = Bench(ControllerSettings(supervision=SupervisionSettings(hold_limit=0.5))).start()
        bench.plan((0.0, 0.0, 0.0))
        bench.tick(count=100 + 500)
        assert bench.controller.mode is Mode.HOLDING
        bench.tick(count=2)
        assert bench.controller.mode is Mode.STOPPED
        assert bench.controller.stop_reason == "no valid plan for 0.5 s"

    def test_arm_that_never_had_a_plan_is_held_without_limit(self):
        bench = Bench(ControllerSettings(supervision=SupervisionSettings(hold_limit=0.1))).start()
        bench.tick(count=1000)
        assert bench.controller.mode is Mode.HOLDING


class TestStop:
    def test_stop_is_damping_and_gravity_only(self, bench):
        bench.plan(*[(0.01, 0.0, 0.0)] * 30)
        bench.tick(count=100)
        bench.controller.stop("test")
        v = np.full(ARM.n, 0.1)
        bench.tick(v=v, count=100)
        model = RobotModel(ARM)
        model.update(HOME, v)
        damping = model.bias - bench.torque
        assert (damping > 0).all()
        twice = bench.tick(v=2 * v, count=100)
        model.update(HOME, 2 * v)
        np.testing.assert_allclose(model.bias - twice, 2 * damping, rtol=1e-9)
        np.testing.assert_allclose(bench.tick(count=100), GRAVITY, rtol=0, atol=1e-9)


class TestReset:
    def test_plans_from_before_the_reset_are_refused(self, bench):
        bench.plan(*[(0.01, 0.0, 0.0)] * 20)
        bench.tick(count=10)
        before_ns = bench.now_ns
        bench.controller.stop("test")
        bench.tick(count=10)
        bench.reset()
        bench.tick()
        assert bench.controller.mode is Mode.HOLDING
        with pytest.raises(InputError, match="before the last stop"):
            bench.plan((0.01, 0.0, 0.0), stamp_ns=before_ns)
        bench.plan((0.01, 0.0, 0.0))
        bench.tick()
        assert bench.controller.mode is Mode.TRACKING


class TestTorques:
    def test_rate_holds_across_every_transition(self):
        patient = SupervisionSettings(hold_limit=0.2, drive_brakes=False)
        bench = Bench(ControllerSettings(supervision=patient)).start()
        random = np.random.default_rng(0)
        torques = [bench.tick()]

        def ticks(count: int) -> None:
            for _ in range(count):
                # What a collision would do to the state, so that the laws ask for jumps.
                torques.append(bench.tick(HOME + 0.3 * random.standard_normal(ARM.n), random.standard_normal(ARM.n)))

        for _ in range(3):
            bench.plan((0.1, -0.1, 0.1))
            ticks(50)
            bench.plan((-0.1, 0.1, -0.1))
            ticks(150)
            ticks(250)
            assert bench.controller.mode is Mode.STOPPED
            torques.append(bench.tick())
            bench.controller.reset(bench.now_ns)
            ticks(30)
            bench.controller.stop("test")
            ticks(5)
            torques.append(bench.tick())
            bench.controller.reset(bench.now_ns)
        shares = np.abs(np.diff(torques, axis=0)) / STEP
        assert shares.max() <= 1 + 1e-9
        assert (shares.max(axis=0) > 0.99).all()

    def test_cap_is_the_declared_share(self):
        settings = dataclasses.replace(UNWATCHED, limits=LimitSettings(torque_share=0.3))
        bench = Bench(settings).start()
        bench.plan(*[(1.0, 1.0, 1.0)] * 20)
        torque = bench.tick(count=1500)
        cap = 0.3 * np.array([320, 320, 176, 176, 110, 40, 40])
        assert (np.abs(torque) <= cap).all()
        assert (np.abs(torque) == cap).any()

    @pytest.mark.parametrize("back_ns", [TICK_NS, 3600 * SECOND_NS])
    def test_clock_that_is_set_back_changes_nothing(self, back_ns):
        v, torques = np.full(ARM.n, 0.1), []
        for jump in (0, back_ns):
            bench = Bench().start()
            bench.plan((0.01, 0.0, 0.0))
            bench.tick(count=300)
            assert bench.controller.mode is Mode.HOLDING
            bench.now_ns -= jump
            stamps = range(bench.now_ns, bench.now_ns + 400 * TICK_NS, TICK_NS)
            torques.append([bench.controller.tick(HOME, v, stamp_ns, stamp_ns) for stamp_ns in stamps])
        # The tick at the jump counts as one of no duration, and the rate limit sees one tick more.
        np.testing.assert_allclose(torques[0][50:-1], torques[1][51:], rtol=0, atol=1e-9)


class TestBehindAnAdapter:
    SETTINGS = dataclasses.replace(UNWATCHED, supervision=dataclasses.replace(UNWATCHED.supervision, adapter=True))

    def test_while_commands_do_not_act_the_arm_is_held_where_it_is_found(self):
        bench, elsewhere = Bench(self.SETTINGS).start(), HOME + 0.3
        bench.plan((0.0, 0.03, 0.0))
        bench.tick()
        assert bench.controller.references.active is None
        # Somebody guides the arm away; when commands act again, nothing pulls it back.
        bench.tick(elsewhere, count=10)
        bench.controller.in_force = True
        torque = bench.tick(elsewhere, count=1000)
        np.testing.assert_allclose(torque, RobotModel(ARM).gravity_at(elsewhere), atol=1e-6)

    def test_a_plan_ends_with_the_force_of_commands(self):
        bench = Bench(self.SETTINGS).start()
        bench.controller.in_force = True
        bench.plan((0.0, 0.03, 0.0))
        bench.tick(count=20)
        assert bench.controller.mode is Mode.TRACKING
        bench.controller.in_force = False
        bench.tick()
        assert bench.controller.mode is Mode.HOLDING and bench.controller.references.active is None
        bench.controller.in_force = True
        bench.tick(count=20)
        assert bench.controller.mode is Mode.HOLDING


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


def test_the_start_is_refused_while_others_command_the_arm(controller):
    controller.not_yet = "somebody else commands the arm"
    for tick in range(5):
        with pytest.raises(InputError, match="somebody else commands the arm; nothing is commanded"):
            update(controller, state(tick))
    assert not controller.started
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


def test_after_a_reset_the_arm_is_held_in_the_last_state(holding):
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

    def test_its_first_report_that_doubts_nothing_starts_the_arm(self, controller):
        assert update(controller, state(0)) is None
        assert "nothing heard from the observer yet" in controller.not_vouched
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

    @pytest.mark.parametrize("period_ms", [1, 10])
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
    def holding(self, request) -> Controller:
        task = getattr(request, "param", "pose")
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

    def test_a_position_that_is_too_far_is_dropped_with_both_distances(self, holding):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(position + np.array([0.0, 0.051, 0.0]), rotation, HOME))
        assert "x_d is 0.051 m from the tip, permitted 0.05 m (max_position_error)" in found

    @pytest.mark.parametrize("holding", ["position_and_axis"], indirect=True)
    @pytest.mark.parametrize(("axis", "dropped"), [([0.0, 0.0, 1.0], False), ([1.0, 0.0, 0.0], True)])
    def test_only_the_axis_counts_where_law_one_controls_no_more(self, holding, axis, dropped):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(position, rotation @ rotation_about(axis, 1.0), HOME))
        assert ("x_d is turned by 1.00 rad" in found) == dropped

    def test_so_is_a_posture_and_the_joint_is_named(self, holding):
        pose = RobotModel(ARM).tip_pose(HOME)
        found = self.offered(holding, Reference(*pose, HOME + 0.6 * np.eye(ARM.n)[5]))
        assert f"q_d is 0.60 rad from {ARM.joint_names[5]}, permitted 0.5 rad" in found

    def test_a_plan_that_lasts_too_long_is_refused(self, holding):
        with pytest.raises(InputError, match="the plan lasts 2 s; expected at most 1 s"):
            self.offered(holding, Reference(*RobotModel(ARM).tip_pose(HOME), HOME), 2 * SECOND_NS)

    @pytest.mark.parametrize(("axis", "past"), [("x", -2.1), ("z", 2.1)])
    def test_a_plan_is_dropped_where_it_leaves_the_workspace(self, holding, axis, past):
        position, rotation = RobotModel(ARM).tip_pose(HOME)
        position["xyz".index(axis)] = past
        found = self.offered(holding, Reference(position, rotation, HOME))
        assert f"{axis} of x_d is {past:.3f} m, permitted " in found
