"""What the controller does about plans, states, observer and stops, without a simulated arm."""

import dataclasses
import math

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, SECOND_NS, TICK_NS, UNWATCHED, offer_plan, patient_controller

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import HOLD_BLEND, START_RAMP, ControllerSettings
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, Verdict

SETTINGS = UNWATCHED
RAMP_TICKS = round(1000 * SETTINGS.impedance.reference_ramp)
PLAN_NS = SECOND_NS // 10
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


def gravity(q: np.ndarray = HOME) -> np.ndarray:
    return RobotModel(ARM).gravity_at(q)


class TestStart:
    def test_first_command_holds_the_arm(self, bench):
        np.testing.assert_allclose(bench.tick(), gravity(), rtol=0, atol=1e-9)

    def test_first_command_of_an_arm_that_compensates_gravity_itself_is_zero(self):
        settings = ControllerSettings(supervision=SupervisionSettings(gravity_compensation=False))
        np.testing.assert_array_equal(Bench(settings).start().tick(), 0)

    def test_authority_ramps_in(self):
        steps = dataclasses.replace(SETTINGS, impedance=ImpedanceSettings(reference_ramp=0.0))
        bench = Bench(steps).start()
        bench.plan((0.002, 0.0, 0.0), (0.002, 0.0, 0.0), (0.002, 0.0, 0.0), (0.002, 0.0, 0.0))
        pulls = [np.linalg.norm(bench.tick() - gravity()) for _ in range(400)]
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
        np.testing.assert_allclose(bench.tick(count=100), gravity(), rtol=0, atol=1e-9)


class TestObserver:
    def test_silent_observer_stops_the_arm(self, bench):
        bench.controller.hear(Verdict(), bench.now_ns)
        bench.tick(count=51)
        assert bench.controller.mode is Mode.HOLDING
        bench.tick()
        assert bench.controller.mode is Mode.STOPPED
        assert bench.controller.stop_reason == "observer silent for 51 ms"

    def test_stop_of_the_observer_stops_the_arm_with_its_reason(self, bench):
        bench.controller.hear(Verdict("external torque on lbr_A3"), bench.now_ns)
        assert bench.controller.mode is Mode.STOPPED
        assert bench.controller.stop_reason == "external torque on lbr_A3"


class TestReset:
    def test_reset_while_the_observer_is_silent_is_refused(self, bench):
        bench.controller.hear(Verdict(), bench.now_ns)
        bench.tick(count=100)
        with pytest.raises(InputError, match="observer is silent"):
            bench.reset()
        assert bench.controller.mode is Mode.STOPPED

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

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_state_that_is_not_finite_gives_no_torque_and_leaves_no_trace(self, bench, value):
        bench.tick(count=10)
        bad = HOME.copy()
        bad[2] = value
        with pytest.raises(InputError, match=r"joint_states: position .*finite"):
            bench.tick(q=bad)
        with pytest.raises(InputError, match=r"joint_states: velocity .*finite"):
            bench.tick(v=bad)
        np.testing.assert_allclose(bench.tick(), gravity(), rtol=0, atol=1e-6)

    @pytest.mark.parametrize("back_ns", [TICK_NS, SECOND_NS // 2, 3600 * SECOND_NS])
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
        bench.tick(count=10)
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
