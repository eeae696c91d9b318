"""Whatever comes, in whatever order: torques stay finite, capped and slow, and a stop stays."""

import hypothesis
import numpy as np
from arm_simulation import HOME, SECOND_NS, TICK_NS, TORQUE_LIMITS
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot.model import RobotModel

SETTINGS = ControllerSettings()
CAP = SETTINGS.limits.torque_share * TORQUE_LIMITS
STEP = torque_rates(SETTINGS.limits) * TICK_NS / SECOND_NS

numbers = st.one_of(st.floats(-3.0, 3.0), st.floats(), st.sampled_from([0.0, 1e-300, 1e308, -1e160]))
small_changes = st.lists(st.floats(-0.5, 0.5), min_size=7, max_size=7).map(np.array)
vectors = st.lists(numbers, min_size=7, max_size=7).map(np.array)
durations = st.one_of(st.just(TICK_NS), st.integers(-SECOND_NS, 10 * SECOND_NS))


class RoughHandling(RuleBasedStateMachine):
    """States, plans, reports, stops and resets, good and bad."""

    def __init__(self) -> None:
        super().__init__()
        self.controller = Controller(SETTINGS, RobotModel())
        self.now_ns = 0
        self.clock_ns = 0
        self.torque = np.zeros(7)

    @initialize()
    def start(self) -> None:
        self.controller.start(HOME, np.zeros(7), 0)
        self.torque = self.controller.tick(HOME, np.zeros(7), 0, 0)

    def show(self, q: np.ndarray, v: np.ndarray) -> None:
        stopped = self.controller.supervisor.stopped
        try:
            torque = self.controller.tick(q, v, self.now_ns, self.clock_ns)
        except InputError:
            return
        assert (torque is None) == (self.controller.mode is Mode.SILENT)
        assert not stopped or self.controller.supervisor.stopped
        if torque is None:
            return
        assert np.isfinite(torque).all()
        assert (np.abs(torque) <= CAP).all()
        assert (np.abs(torque - self.torque) <= STEP * (1 + 1e-9)).all()
        self.torque = torque

    @rule(change=small_changes, v=small_changes, duration=durations)
    def possible_state(self, change: np.ndarray, v: np.ndarray, duration: int) -> None:
        self.now_ns += duration
        self.clock_ns += max(duration, 0)
        self.show(HOME + change, v)

    @rule(q=vectors, v=vectors)
    def any_state(self, q: np.ndarray, v: np.ndarray) -> None:
        with np.errstate(all="ignore"):
            self.show(q, v)

    @rule(lead=st.integers(-SECOND_NS, SECOND_NS), position=vectors, posture=vectors, end=durations)
    def plan(self, lead: int, position: np.ndarray, posture: np.ndarray, end: int) -> None:
        stamp = self.now_ns + lead
        try:
            poses = PoseKnots(stamp, (end,), position[None, :3], np.eye(3)[None])
            self.controller.references.offer_poses(poses, self.now_ns)
            self.controller.references.offer_postures(PostureKnots(stamp, (end,), posture[None]), self.now_ns)
        except InputError as error:
            assert str(error).startswith("reference/")

    @rule(reason=st.sampled_from(["", "", "pushed"]), distrust=st.sampled_from(["", "", "", "stuck"]))
    def observer(self, reason: str, distrust: str) -> None:
        self.controller.observer_report(reason or distrust, self.clock_ns, distrust)

    @rule()
    def stop(self) -> None:
        self.controller.stop("test")

    @precondition(lambda self: self.controller.supervisor.stopped)
    @rule(change=small_changes, speed=st.floats(-0.1, 0.1))
    def reset(self, change: np.ndarray, speed: float) -> None:
        reason, mode = self.controller.stop_reason, self.controller.mode
        try:
            self.controller.reset(HOME + change, np.full(7, speed), self.now_ns, self.clock_ns)
        except InputError:
            assert (self.controller.mode, self.controller.stop_reason) == (mode, reason)
        else:
            assert abs(speed) <= SETTINGS.supervision.reset_velocity
            assert self.controller.mode is Mode.HOLDING
            if mode is Mode.SILENT:
                # Nothing was commanded: what holds the arm comes first, whatever was commanded before.
                self.torque = np.clip(self.controller.model.gravity, -CAP, CAP)

    @invariant()
    def stop_has_a_reason(self) -> None:
        assert self.controller.supervisor.stopped == bool(self.controller.stop_reason)


TestRoughHandling = RoughHandling.TestCase
TestRoughHandling.settings = hypothesis.settings(max_examples=50, stateful_step_count=40)
