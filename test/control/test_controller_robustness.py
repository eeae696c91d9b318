"""Whatever comes, in whatever order: torques stay finite, capped and slow, and a stop stays."""

import hypothesis
import numpy as np
from arm_simulation import ARM, HOME, SECOND_NS, TICK_NS, TORQUE_LIMITS, UNWATCHED
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.references import References
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, Verdict
from contact_reach_ros.timing import PAUSE

SETTINGS = UNWATCHED
CAP = SETTINGS.limits.torque_share * TORQUE_LIMITS
STEP = torque_rates(ARM, SETTINGS.limits) * TICK_NS / SECOND_NS

numbers = st.one_of(st.floats(-3.0, 3.0), st.floats(), st.sampled_from([0.0, 1e-300, 1e308, -1e160]))
small_changes = st.lists(st.floats(-0.5, 0.5), min_size=ARM.n, max_size=ARM.n).map(np.array)
vectors = st.lists(numbers, min_size=ARM.n, max_size=ARM.n).map(np.array)
durations = st.one_of(st.just(TICK_NS), st.integers(-SECOND_NS, 10 * SECOND_NS))


class RoughHandling(RuleBasedStateMachine):
    """States, plans, reports, stops and resets, good and bad."""

    def __init__(self) -> None:
        super().__init__()
        self.controller = Controller(ARM, SETTINGS)
        self.now_ns = 0
        self.clock_ns = 0
        self.sent_ns = 0
        self.torque = np.zeros(ARM.n)

    @initialize()
    def start(self) -> None:
        self.torque = self.controller.update(JointState(0, HOME, np.zeros(ARM.n), None), 0)

    def show(self, q: np.ndarray, v: np.ndarray, in_order: bool = True) -> None:
        """Show a state; out of order, one that is answered whatever its stamp."""
        stopped = self.controller.supervisor.stopped
        state = JointState(self.now_ns, q, v, None)
        try:
            if in_order:
                torque = self.controller.update(state, self.clock_ns)
            else:
                torque = self.controller.tick(q, v, self.now_ns, self.clock_ns)
        except InputError:
            return
        if in_order and self.controller.state is not state:
            assert torque is None
            return
        assert (torque is None) == (self.controller.mode is Mode.SILENT)
        assert not stopped or self.controller.supervisor.stopped
        if torque is None:
            return
        assert np.isfinite(torque).all()
        assert (np.abs(torque) <= CAP).all()
        # After a pause the drive has taken over; a new start begins with the torque that holds the arm.
        paused = self.clock_ns - self.sent_ns > PAUSE * SECOND_NS
        assert paused or (np.abs(torque - self.torque) <= STEP * (1 + 1e-9)).all()
        self.torque, self.sent_ns = torque, self.clock_ns

    @rule(change=small_changes, v=small_changes, duration=durations, in_order=st.booleans())
    def possible_state(self, change: np.ndarray, v: np.ndarray, duration: int, in_order: bool) -> None:
        self.now_ns += duration
        self.clock_ns += max(duration, 0)
        self.show(HOME + change, v, in_order)

    @rule(q=vectors, v=vectors)
    def any_state(self, q: np.ndarray, v: np.ndarray) -> None:
        with np.errstate(all="ignore"):
            self.show(q, v, in_order=False)

    @rule(lead=st.integers(-SECOND_NS, SECOND_NS), position=vectors, posture=vectors, end=durations)
    def plan(self, lead: int, position: np.ndarray, posture: np.ndarray, end: int) -> None:
        stamp = self.now_ns + lead
        try:
            self.controller.follow(References(stamp, (end,), position[None, :3], np.eye(3)[None], posture[None]))
        except InputError as error:
            assert str(error).startswith("reference/")

    @rule(reason=st.sampled_from(["", "", "pushed"]), distrust=st.sampled_from(["", "", "", "stuck"]))
    def observer(self, reason: str, distrust: str) -> None:
        self.controller.hear(Verdict(reason or distrust, distrust), self.clock_ns)

    @rule()
    def stop(self) -> None:
        self.controller.stop("test")

    @precondition(lambda self: self.controller.supervisor.stopped)
    @rule(change=small_changes, speed=st.floats(-0.1, 0.1))
    def reset(self, change: np.ndarray, speed: float) -> None:
        self.show(HOME + change, np.full(ARM.n, speed))
        reason, mode = self.controller.stop_reason, self.controller.mode
        try:
            self.controller.reset(self.clock_ns)
        except InputError:
            assert (self.controller.mode, self.controller.stop_reason) == (mode, reason)
        else:
            assert np.abs(self.controller.state.v).max() <= SETTINGS.supervision.reset_velocity
            assert self.controller.mode is Mode.HOLDING
            if mode is Mode.SILENT:
                # Nothing was commanded: what holds the arm comes first, whatever was commanded before.
                self.torque = np.clip(self.controller.model.gravity, -CAP, CAP)

    @invariant()
    def stop_has_a_reason(self) -> None:
        assert self.controller.supervisor.stopped == bool(self.controller.stop_reason)


TestRoughHandling = RoughHandling.TestCase
TestRoughHandling.settings = hypothesis.settings(max_examples=50, stateful_step_count=40)
