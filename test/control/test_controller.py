"""What the controller does about plans, states, observer and stops, without a simulated arm; each state once."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, SECOND_NS, TICK_NS, UNWATCHED, references_of, rotation_about

from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.controller import START_RAMP, Controller
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, Verdict

RAMP_TICKS = round(1000 * UNWATCHED.impedance.reference_ramp)
PLAN_NS = SECOND_NS // 10
POSE = RobotModel(ARM).tip_pose(HOME)
ASIDE = (0.01, 0.0, 0.0)


def weight_at(q: np.ndarray) -> np.ndarray:
    return RobotModel(ARM).gravity_at(q)


GRAVITY = weight_at(HOME)


def unwatched(**supervision) -> ControllerSettings:
    """The settings of a controller that needs no observer, with others of its supervision."""
    return dataclasses.replace(UNWATCHED, supervision=dataclasses.replace(UNWATCHED.supervision, **supervision))


class Bench:
    """A controller that is shown a state each millisecond."""

    def __init__(self, settings: ControllerSettings = UNWATCHED) -> None:
        self.controller = Controller(ARM, settings)
        self.now_ns = TICK_NS

    @property
    def mode(self) -> Mode:
        return self.controller.mode

    def tick(self, q: np.ndarray = HOME, v: np.ndarray = REST, count: int = 1) -> np.ndarray | None:
        """The torque for the last of the states."""
        for _ in range(count):
            torque = self.controller.update(JointState(self.now_ns, q, v, None), self.now_ns)
            self.now_ns += TICK_NS
        return torque

    def errors(self, count: int) -> list[float]:
        """How far the reference is ahead of the tip along x in the next ticks, m."""
        errors = []
        for _ in range(count):
            self.tick()
            errors.append(-self.controller.error[0])
        return errors

    def plan(self, *offsets: tuple[float, float, float], stamp_ns: int | None = None) -> None:
        """Offer a plan of 0.1 s for each offset from the home pose."""
        knots = [Reference(POSE[0] + offset, POSE[1], HOME) for offset in offsets]
        ends = tuple(PLAN_NS * (index + 1) for index in range(len(offsets)))
        self.controller.follow(references_of(knots, self.now_ns if stamp_ns is None else stamp_ns, ends))

    def hear(self, verdict: Verdict = Verdict()) -> None:  # noqa: B008
        self.controller.hear(verdict, self.now_ns)


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def holding(bench) -> Bench:
    """It has answered ten states."""
    bench.tick(count=10)
    return bench


class TestStart:
    def test_the_first_state_starts_it_with_the_torque_that_holds_the_arm(self, bench):
        assert (bench.controller.started, bench.controller.state, bench.mode) == (False, None, Mode.WAITING)
        np.testing.assert_allclose(bench.tick(), GRAVITY, rtol=0, atol=1e-9)
        assert (bench.controller.started, bench.mode) == (True, Mode.HOLDING)
        assert bench.controller.state.stamp_ns == TICK_NS

    def test_first_command_of_an_arm_that_compensates_gravity_itself_is_zero(self):
        np.testing.assert_array_equal(Bench(unwatched(gravity_compensation=False)).tick(), 0)

    def test_it_is_refused_while_others_command_the_arm(self, bench):
        bench.controller.not_yet = "somebody else commands the arm"
        with pytest.raises(InputError, match="somebody else commands the arm; nothing is commanded"):
            bench.tick()
        assert not bench.controller.started
        bench.controller.not_yet = ""
        assert bench.tick() is not None

    def test_an_arm_outside_its_limits_is_not_started(self, bench):
        beyond = np.where(np.arange(ARM.n) == 1, ARM.upper + 0.01, HOME)
        with pytest.raises(InputError, match=f"{ARM.joint_names[1]} beyond the position limit"):
            bench.tick(beyond)
        assert not bench.controller.started
        assert bench.tick() is not None

    def test_authority_ramps_in(self):
        bench = Bench(dataclasses.replace(UNWATCHED, impedance=ImpedanceSettings(reference_ramp=0.0)))
        bench.tick()
        bench.plan(*[(0.002, 0.0, 0.0)] * 4)
        pulls = [np.linalg.norm(bench.tick() - GRAVITY) for _ in range(400)]
        ramp = START_RAMP
        np.testing.assert_allclose(pulls, np.arange(1, 401) * 1e-3 / ramp * pulls[-1] / (0.4 / ramp), atol=1e-9)

    def test_after_an_activation_the_next_state_starts_it_again_whatever_its_stamp(self, holding):
        holding.plan(ASIDE)
        holding.tick(count=20)
        assert holding.mode is Mode.TRACKING
        holding.controller.activate()
        assert not holding.controller.started
        holding.now_ns, elsewhere = 0, HOME + 0.1
        np.testing.assert_allclose(holding.tick(elsewhere), weight_at(elsewhere), rtol=0, atol=1e-9)
        assert holding.mode is Mode.HOLDING
        np.testing.assert_allclose(holding.controller.error, 0, atol=1e-9)


class TestPlans:
    def test_plan_is_tracked_from_its_stamp_to_its_last_knot(self, bench):
        bench.tick(count=10)
        bench.plan(ASIDE, (0.02, 0.0, 0.0), stamp_ns=bench.now_ns + PLAN_NS)
        seen = [(*bench.errors(1), bench.mode) for _ in range(400)]
        modes = [mode for _, mode in seen]
        assert set(modes[:100]) == {Mode.HOLDING}
        assert set(modes[100:300]) == {Mode.TRACKING}
        assert set(modes[300:]) == {Mode.HOLDING}
        moved = 0.01 * np.minimum(np.arange(1, 101) / RAMP_TICKS, 1.0)
        np.testing.assert_allclose([error for error, _ in seen[100:200]], moved, atol=1e-9)
        np.testing.assert_allclose([error for error, _ in seen[200:300]], 0.01 + moved, atol=1e-9)

    def test_a_plan_takes_over_from_one_whose_knot_was_not_reached_yet(self, bench):
        bench.tick(count=10)
        bench.plan((0.02, 0.0, 0.0))
        bench.tick(count=RAMP_TICKS // 2)
        bench.plan((0.0, 0.0, 0.0))
        np.testing.assert_allclose(bench.errors(RAMP_TICKS), np.linspace(0.01, 0.0, RAMP_TICKS + 1)[1:], atol=1e-9)

    @pytest.mark.parametrize("ends", ["runs out", "is withdrawn"])
    def test_without_one_the_arm_is_held_where_it_is_at_once(self, holding, ends):
        holding.plan((0.03, 0.0, 0.0))
        holding.tick(count=100 if ends == "runs out" else 60)
        assert holding.controller.error[0] == pytest.approx(-0.03)
        if ends == "is withdrawn":
            holding.controller.withdraw()
        np.testing.assert_allclose(holding.errors(50), 0.0, atol=1e-9)
        assert holding.mode is Mode.HOLDING

    def test_without_one_the_arm_is_held_but_none_for_too_long_after_one_stops_it(self):
        bench = Bench(unwatched(hold_limit=0.5))
        bench.tick(count=1000)
        bench.plan((0.0, 0.0, 0.0))
        bench.tick(count=100 + 500)
        assert bench.mode is Mode.HOLDING
        bench.tick(count=2)
        assert bench.mode is Mode.STOPPED
        assert bench.controller.stop_reason == "no valid plan for 0.5 s"

    @pytest.mark.parametrize("back_ns", [TICK_NS, 3600 * SECOND_NS])
    def test_clock_that_is_set_back_changes_nothing(self, back_ns):
        v, torques = np.full(ARM.n, 0.1), []
        for jump in (0, back_ns):
            bench = Bench()
            bench.plan(ASIDE)
            bench.tick(count=300)
            assert bench.mode is Mode.HOLDING
            first = bench.now_ns - jump
            stamps = range(first, first + 400 * TICK_NS, TICK_NS)
            torques.append([bench.controller._tick(HOME, v, stamp_ns, stamp_ns) for stamp_ns in stamps])
        # The tick at the jump counts as one of no duration, and the rate limit sees one tick more.
        np.testing.assert_allclose(torques[0][50:-1], torques[1][51:], rtol=0, atol=1e-9)


def turned(axis: list[float]) -> Reference:
    return Reference(POSE[0], POSE[1] @ rotation_about(axis, 1.0), HOME)


class TestBounds:
    """Plans that lead too far from the arm, or last too long, are not followed."""

    def offer(self, wanted: Reference, task: str = "pose", duration_ns: int = PLAN_NS) -> str:
        """Why a plan of one reference is dropped, empty if it is followed."""
        supervision = SupervisionSettings(require_observer=False)
        bench = Bench(ControllerSettings(impedance=ImpedanceSettings(task=task), supervision=supervision))
        bench.tick()
        bench.controller.follow(references_of([wanted], bench.now_ns, (duration_ns,)))
        bench.tick()
        dropped = bench.controller.follower.queue.dropped
        assert (bench.mode is Mode.TRACKING) == (not dropped)
        return "; ".join(dropped)

    @pytest.mark.parametrize(
        ("position", "posture", "expected"),
        [
            ((0.0, 0.051, 0.0), REST, "x_d is 0.051 m from the tip, permitted 0.05 m (max_position_error)"),
            ((0.0, 0.0, 0.0), 0.6 * np.eye(ARM.n)[5], f"q_d is 0.60 rad from {ARM.joint_names[5]}, permitted 0.5 rad"),
            ((-2.1 - POSE[0][0], 0.0, 0.0), REST, "x of x_d is -2.100 m, permitted "),
            ((0.0, 0.0, 2.1 - POSE[0][2]), REST, "z of x_d is 2.100 m, permitted "),
        ],
    )
    def test_a_plan_is_dropped_where_it_leads_too_far(self, position, posture, expected):
        assert expected in self.offer(Reference(POSE[0] + position, POSE[1], HOME + posture))

    def test_only_the_axis_counts_where_law_one_controls_no_more(self):
        assert not self.offer(turned([0.0, 0.0, 1.0]), "position_and_axis")
        assert "x_d is turned by 1.00 rad" in self.offer(turned([1.0, 0.0, 0.0]), "position_and_axis")

    def test_a_plan_that_lasts_too_long_is_refused(self):
        with pytest.raises(InputError, match="the plan lasts 2 s; expected at most 1 s"):
            self.offer(Reference(*POSE, HOME), duration_ns=2 * SECOND_NS)


class TestStop:
    def test_it_is_damping_and_gravity_only(self, holding):
        holding.controller.stop("test")
        v = np.full(ARM.n, 0.01)
        damping = GRAVITY - holding.tick(v=v, count=15)
        assert damping @ v > 0
        twice = GRAVITY - holding.tick(v=2 * v, count=15)
        np.testing.assert_allclose(twice, 2 * damping, rtol=1e-6)
        # A velocity that stays as it is to the last bit, and moves nothing, is an old one.
        np.testing.assert_allclose(holding.tick(v=2 * v, count=20), GRAVITY, rtol=0, atol=1e-9)
        np.testing.assert_allclose(holding.tick(count=100), GRAVITY, rtol=0, atol=1e-9)

    def test_an_activation_does_not_release_it(self, holding):
        holding.controller.stop("pushed")
        holding.controller.activate()
        holding.tick()
        assert (holding.mode, holding.controller.stop_reason) == (Mode.STOPPED, "pushed")

    def test_after_a_reset_damping_acts_within_50_ms(self, holding):
        """What the stop held is let go then, and must not fall."""
        holding.controller.stop("test")
        holding.tick(count=10)
        holding.controller.reset(holding.now_ns)
        v = np.full(ARM.n, 0.05)
        first = (GRAVITY - holding.tick(v=v)) @ v
        holding.tick(v=v, count=50)
        full = (GRAVITY - holding.tick(v=v)) @ v
        assert 0.0 <= first < 0.05 * full
        assert full == pytest.approx((GRAVITY - holding.tick(v=v, count=500)) @ v, rel=0.05)

    def test_after_a_reset_the_arm_is_held_where_it_is_and_plans_from_before_are_refused(self, bench):
        bench.plan(*[ASIDE] * 5)
        bench.tick(count=10)
        before_ns, elsewhere = bench.now_ns, HOME + 0.2
        bench.controller.stop("test")
        bench.tick(elsewhere, count=50)
        bench.controller.reset(bench.now_ns)
        assert (bench.mode, bench.controller.stop_reason) == (Mode.HOLDING, "")
        bench.tick(elsewhere)
        np.testing.assert_allclose(bench.controller.error, 0, atol=1e-9)
        with pytest.raises(InputError, match="before the last stop"):
            bench.plan(ASIDE, stamp_ns=before_ns)
        bench.plan(ASIDE)
        bench.tick(elsewhere)
        assert bench.mode is Mode.TRACKING


class TestStates:
    @pytest.mark.parametrize(("back", "repeated", "older"), [(1, 1, 0), (2, 0, 1), (1010, 0, 1)])
    def test_one_that_comes_again_or_late_has_no_answer_and_leaves_no_trace(self, holding, back, repeated, older):
        answered, now_ns = holding.controller.state, holding.now_ns
        holding.now_ns -= back * TICK_NS
        assert holding.tick(HOME + 0.1, REST + 1.0) is None
        assert holding.controller.state is answered
        assert (holding.controller.order.repeated, holding.controller.order.older) == (repeated, older)
        holding.now_ns = now_ns
        np.testing.assert_allclose(holding.tick(), GRAVITY, rtol=0, atol=1e-6)

    def test_after_a_pause_the_arm_is_held_where_it_was_put_and_nothing_pulls_it_back(self, holding):
        holding.plan(*[(0.0, 0.0, 0.0)] * 9)
        holding.tick()
        assert holding.mode is Mode.TRACKING
        elsewhere = HOME + np.array([0.3, -0.2, 0.1, 0.2, 0.0, 0.0, 0.0])
        holding.now_ns += SECOND_NS // 2
        torques = [holding.tick(elsewhere) for _ in range(1000)]
        assert holding.mode is Mode.HOLDING
        np.testing.assert_allclose(torques, np.tile(weight_at(elsewhere), (1000, 1)), rtol=0, atol=1e-6)


class TestBehindAnAdapter:
    @pytest.fixture
    def bench(self) -> Bench:
        bench = Bench(unwatched(adapter=True))
        bench.tick()
        return bench

    def test_while_commands_do_not_act_the_arm_is_held_where_it_is_found(self, bench):
        bench.plan((0.0, 0.03, 0.0))
        bench.tick()
        assert bench.controller.follower.queue.active is None
        # Somebody guides the arm away; when commands act again, nothing pulls it back.
        elsewhere = HOME + 0.3
        bench.tick(elsewhere, count=10)
        bench.controller.in_force = True
        np.testing.assert_allclose(bench.tick(elsewhere, count=1000), weight_at(elsewhere), atol=1e-6)

    def test_a_plan_ends_with_the_force_of_commands(self, bench):
        bench.controller.in_force = True
        bench.plan((0.0, 0.03, 0.0))
        bench.tick(count=20)
        assert bench.mode is Mode.TRACKING
        bench.controller.in_force = False
        bench.tick()
        bench.controller.in_force = True
        bench.tick(count=20)
        assert bench.mode is Mode.HOLDING and bench.controller.follower.queue.active is None


class TestVouching:
    """Nothing is commanded until the observer has vouched for the states."""

    @pytest.fixture
    def bench(self) -> Bench:
        return Bench(ControllerSettings())

    def test_its_first_report_that_doubts_nothing_starts_the_arm(self, bench):
        assert bench.tick() is None
        assert "nothing heard from the observer yet" in bench.controller.not_vouched
        for verdict in (Verdict(doubt="first states"), Verdict("blind: ..."), Verdict()):
            bench.hear(verdict)
            assert (bench.tick() is None) == bool(verdict.reason or verdict.doubt)
        assert bench.controller.started and not bench.controller.not_vouched

    def test_blindness_stops_the_arm_and_has_to_be_over_before_a_reset(self, bench):
        bench.hear()
        bench.tick()
        bench.hear(Verdict("blind: no effort"))
        assert (bench.mode, bench.controller.stop_reason) == (Mode.STOPPED, "blind: no effort")
        with pytest.raises(InputError, match="the observer is stopped"):
            bench.controller.reset(bench.now_ns)
        bench.hear()
        bench.controller.reset(bench.now_ns)
        assert bench.mode is Mode.HOLDING

    def test_plans_wait_for_known_torques(self, bench):
        bench.hear(Verdict(torque_known=False))
        bench.tick()
        bench.plan(ASIDE)
        bench.tick()
        assert bench.mode is Mode.HOLDING
        bench.hear()
        bench.tick()
        assert bench.mode is Mode.TRACKING

    @pytest.mark.parametrize("period_ms", [1, 10])
    def test_a_dead_observer_is_noticed_at_every_rate_however_long_the_pauses_between_states(self, bench, period_ms):
        bench.hear()
        while not bench.controller.stop_reason:
            bench.tick()
            bench.now_ns += (period_ms - 1) * TICK_NS
        assert bench.controller.stop_reason.startswith("observer silent")
        assert bench.now_ns <= (252 + 3 * period_ms) * TICK_NS
