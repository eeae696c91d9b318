"""Controller and observer together, under any sequence of states, plans, heartbeats, stops and resets."""

import math
import re

import hypothesis
import numpy as np
import pytest
from arm_simulation import ARM, HOME, SECOND_NS, TICK_NS, TORQUE_LIMITS
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from contact_reach_ros.arm import REST_SPEED, JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.constants import torque_rates
from contact_reach_ros.control.controller import HELD_AFTER, Controller
from contact_reach_ros.control.references import References
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.control.supervisor import OBSERVER_TIMEOUT, Mode
from contact_reach_ros.errors import InputError, Verdict
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings

SETTINGS = ControllerSettings()
CAP = SETTINGS.limits.torque_share * TORQUE_LIMITS
STEP = torque_rates(ARM, SETTINGS.limits) * TICK_NS / SECOND_NS * (1 + 1e-9)
TIMEOUT_NS = round(OBSERVER_TIMEOUT * SECOND_NS)
PAUSE_NS = round(HELD_AFTER * SECOND_NS)
ACTS = (Mode.HOLDING, Mode.TRACKING)
UNKNOWN = np.full(ARM.n, math.nan)
STARTED = 350
"""States, 1 ms apart, after which the hand-over is complete."""

joints = st.integers(0, ARM.n - 1)
odd_numbers = st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e160, 1e5])
numbers = st.one_of(st.floats(-3.0, 3.0), st.floats(), st.sampled_from([0.0, 1e-300, 1e308, -1e160]))
vectors = st.lists(numbers, min_size=ARM.n, max_size=ARM.n).map(np.array)
gaps = st.sampled_from([2, 4, 20, 60, 150, 3000])
counts = st.sampled_from([1, 3, 30, 120])


class SafetyLoop(RuleBasedStateMachine):
    """An arm that carries itself but where it is pushed; what holds after each state is checked there."""

    def __init__(self) -> None:
        super().__init__()
        self.controller = Controller(ARM, SETTINGS)
        self.observer = Observer(ARM, ObserverSettings(), ContactBudget())
        self.model = RobotModel(ARM)
        self.random = np.random.default_rng(0)
        self.q, self.v, self.external = HOME.copy(), np.zeros(ARM.n), np.zeros(ARM.n)
        self.now_ns = self.clock_ns = self.sent_ns = self.seen_ns = 0
        self.sent: np.ndarray | None = None
        self.heartbeats = True
        self.verdict: Verdict | None = None
        self.heard_ns = 0
        self.stopped = False

    # What happens

    @initialize(is_started=st.sampled_from([True, True, True, False]))
    def start(self, is_started: bool) -> None:
        """Wait until the hand-over is over, or not."""
        self.states(STARTED * is_started)

    @rule(count=counts)
    def states(self, count: int) -> None:
        for _ in range(count):
            self.advance()

    @rule(gap=gaps)
    def late_state(self, gap: int) -> None:
        self.advance(gap)

    @rule(back=st.sampled_from([0, 1, 1000]), count=st.sampled_from([1, 4, 30]))
    def repeated_or_older_states(self, back: int, count: int) -> None:
        """The watchdogs' clock goes on."""
        self.now_ns -= back * TICK_NS
        for _ in range(count):
            self.pass_clock(1)
            self.show(self.state())
        self.now_ns = self.clock_ns

    @rule(joint=joints, number=odd_numbers, field=st.sampled_from(["q", "v", "torque"]), count=counts)
    def states_with_an_odd_number(self, joint: int, number: float, field: str, count: int) -> None:
        for _ in range(count):
            value = getattr(self.state(), field).copy()
            value[joint] = number
            self.odd_state(**{field: value})

    @rule(torque=st.sampled_from([None, UNKNOWN]), count=counts)
    def states_without_torque(self, torque: np.ndarray | None, count: int) -> None:
        for _ in range(count):
            self.odd_state(torque=torque)

    @rule(q=vectors, v=vectors)
    def odd_state(self, **changes: np.ndarray | None) -> None:
        self.pass_time(1)
        with np.errstate(all="ignore"):
            self.show(self.state()._replace(**changes))

    @rule(joint=joints, angle=st.floats(-3.0, 3.0))
    def jump(self, joint: int, angle: float) -> None:
        self.q[joint] += angle
        self.advance()

    @rule(joint=joints, speed=st.sampled_from([0.0, 0.0, 0.02, -0.3, 3.0]))
    def motion(self, joint: int, speed: float) -> None:
        self.v[:] = 0.0
        self.v[joint] = speed
        self.states(30)

    @rule(joint=joints, torque=st.sampled_from([0.0, 0.0, 3.0, -20.0, 1e4]))
    def push(self, joint: int, torque: float) -> None:
        self.external[:] = 0.0
        self.external[joint] = torque
        self.states(30)

    @rule(count=counts)
    def good_plan(self, count: int) -> None:
        self.plan(0, (40, 500), 0.01)
        self.states(count)

    @rule(
        lead=st.sampled_from([0, 10, -90, -2000, 5000]),
        ends=st.sampled_from([(100,), (40, 500), (20, 10), (30000,), ()]),
        shift=st.sampled_from([0.0, 0.5, math.nan, math.inf, 1e300]),
    )
    def plan(self, lead: int, ends: tuple[int, ...], shift: float) -> None:
        position, rotation = self.controller.model.tip_pose(HOME)
        count = len(ends)
        stamp_ns, ends_ns = self.now_ns + lead * TICK_NS, tuple(end * TICK_NS for end in ends)
        poses, postures = np.tile(position + shift, (count, 1)), np.tile(HOME + shift, (count, 1))
        try:
            self.controller.follow(References(stamp_ns, ends_ns, poses, np.tile(rotation, (count, 1, 1)), postures))
        except InputError as error:
            assert str(error).startswith("reference/")

    @rule(present=st.booleans())
    def heartbeats_come_or_not(self, present: bool) -> None:
        self.heartbeats = present

    @rule(verdict=st.sampled_from([Verdict("stuck", "stuck", "stuck"), Verdict("pushed"), Verdict(doubt="blind")]))
    def distrusting_report(self, verdict: Verdict) -> None:
        self.hear(verdict)

    @rule()
    def stop(self) -> None:
        self.controller.stop("test")

    @rule(observer_too=st.booleans())
    def reset(self, observer_too: bool) -> None:
        try:
            if observer_too:
                self.observer.reset((self.clock_ns - self.seen_ns) / SECOND_NS)
                self.hear(self.observer.report(self.now_ns).verdict)
            self.controller.reset(self.clock_ns)
        except InputError:
            return
        assert self.controller.mode is Mode.HOLDING
        assert np.abs(self.controller.state.v).max() <= REST_SPEED
        if self.stopped and self.sent is None:
            self.sent = self.hold_torque()
        self.stopped = False

    # How it happens

    def pass_clock(self, milliseconds: int) -> None:
        self.clock_ns += milliseconds * TICK_NS

    def pass_time(self, milliseconds: int) -> None:
        self.pass_clock(milliseconds)
        self.now_ns += milliseconds * TICK_NS
        self.q = np.clip(self.q + self.v * milliseconds * TICK_NS / SECOND_NS, -6.0, 6.0)

    def advance(self, milliseconds: int = 1) -> None:
        self.pass_time(milliseconds)
        self.show(self.state())

    def state(self) -> JointState:
        noise = self.random.standard_normal((2, ARM.n))
        gravity = self.model.gravity_at(self.q)
        torque = gravity - self.external + 0.01 * noise[0]
        return JointState(self.now_ns, self.q + 1e-6 * noise[1], self.v.copy(), torque)

    def hold_torque(self) -> np.ndarray:
        return np.clip(self.controller.model.gravity, -CAP, CAP)

    def hear(self, verdict: Verdict) -> None:
        self.controller.hear(verdict, self.clock_ns)
        self.verdict, self.heard_ns = verdict, self.clock_ns

    def show(self, state: JointState) -> None:
        controller = self.controller
        was_started = controller.started
        try:
            torque = controller.update(state, self.clock_ns)
        except InputError:
            torque = None
        if torque is not None:
            self.check(torque, was_started)
        self.stopped = self.stopped or controller.supervisor.stopped
        try:
            report = self.observer.update(state)
        except InputError:
            report = None
        if report is not None:
            self.seen_ns = self.clock_ns
        if report is not None and report.due and self.heartbeats:
            self.hear(report.verdict)

    # What must hold

    def check(self, torque: np.ndarray, was_started: bool) -> None:
        """What is sent is finite, within cap and rate; and it is not the laws that act unless somebody vouches."""
        controller = self.controller
        assert np.isfinite(torque).all()
        assert (np.abs(torque) <= CAP).all()
        # A new start begins with the torque that holds the arm, and so does what follows a pause in which it was moved.
        is_new = not was_started or self.sent is None
        follows = not is_new and (np.abs(torque - self.sent) <= STEP).all()
        begins = is_new or self.clock_ns - self.sent_ns > PAUSE_NS
        assert follows or (begins and (np.abs(torque - self.hold_torque()) <= STEP).all())
        self.sent, self.sent_ns = torque, self.clock_ns
        assert was_started or self.vouched
        assert controller.mode not in ACTS or self.vouched_lately

    @property
    def vouched(self) -> bool:
        """Whether the last report lets the arm start."""
        verdict = self.verdict
        return verdict is not None and not (verdict.reason or verdict.doubt)

    @property
    def vouched_lately(self) -> bool:
        """Whether nothing in the last report stops the arm, and it is not too old."""
        verdict, silence_ns = self.verdict, self.clock_ns - self.heard_ns
        return verdict is not None and not verdict.reason and silence_ns <= TIMEOUT_NS

    @invariant()
    def a_stop_stays_until_the_reset(self) -> None:
        stopped = self.controller.supervisor.stopped
        assert not self.stopped or stopped
        assert stopped == bool(self.controller.stop_reason)
        self.stopped = stopped

    @invariant()
    def silence_is_silence(self) -> None:
        if self.controller.mode is Mode.SILENT:
            self.sent = None


TestSafetyLoop = SafetyLoop.TestCase
TestSafetyLoop.settings = hypothesis.settings(max_examples=30, stateful_step_count=25)


RATE = 200.0
STRAIGHT, A1 = np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.5, 0.0]), np.eye(ARM.n)[0]
WEIGHT = "at hand-over (the )?external torque on lbr_A. is .* the model has a wrong weight"


def near_limit(inside):
    return np.where(np.arange(ARM.n) == 3, ARM.lower + inside, STRAIGHT)


def turning(speed, share=1.0):
    """The first joint turns, and the state has this share of its speed."""
    return lambda state, t: state._replace(q=state.q + speed * t * A1, v=state.v + share * speed * A1)


def stamped(clock):
    return lambda state, t: state._replace(stamp_ns=round(clock(t) * SECOND_NS))


def with_torque(change):
    return lambda state, t: state._replace(torque=change(state.torque))


DRIVERS = {
    "at rest": (None, HOME, Mode.HOLDING, ""),
    "straight elbow": (None, STRAIGHT, Mode.HOLDING, ""),
    "all zero": (None, np.zeros(ARM.n), Mode.HOLDING, ""),
    "inside a limit": (None, near_limit(0.01), Mode.HOLDING, ""),
    "beyond a limit": (None, near_limit(-0.02), Mode.WAITING, "lbr_A4 beyond the position limit"),
    "in degrees": (
        lambda state, t: state._replace(q=np.rad2deg(state.q)),
        HOME,
        Mode.WAITING,
        "beyond the position limit",
    ),
    "rounded": (lambda state, t: state._replace(q=HOME.round(3), v=np.zeros(ARM.n)), HOME, Mode.HOLDING, ""),
    "in motion": (turning(0.3), HOME, Mode.HOLDING, ""),
    "in fast motion": (turning(1.2), HOME, Mode.STOPPED, "times its permitted speed"),
    "without velocities": (turning(0.3, 0.0), HOME, Mode.SILENT, "position and velocity of lbr_A1 differ"),
    "without stamps": (stamped(lambda t: 0.0), HOME, Mode.WAITING, "stamps .* do not advance"),
    "with old stamps": (stamped(lambda t: t - t % 0.05), HOME, Mode.WAITING, "20 Hz, expected 200 Hz"),
    "with rounded stamps": (stamped(lambda t: round(t, 3)), HOME, Mode.HOLDING, ""),
    "with jittering stamps": (stamped(lambda t: t + 0.004 * math.sin(1e4 * t)), HOME, Mode.HOLDING, ""),
    "with a clock set back": (stamped(lambda t: t - 10.0 * (t > 0.5)), HOME, Mode.HOLDING, ""),
    "with a clock set forward": (
        stamped(lambda t: t + 3600.0 * (t > 0.5)),
        HOME,
        Mode.STOPPED,
        "near enough, by their",
    ),
    "without torques": (with_torque(lambda _: None), HOME, Mode.WAITING, "joint_states carry no effort"),
    "with torques of zero": (with_torque(np.zeros_like), HOME, Mode.SILENT, WEIGHT),
    "with torques of the other sign": (with_torque(np.negative), HOME, Mode.SILENT, WEIGHT),
    "with torques in another order": (with_torque(np.flip), HOME, Mode.SILENT, WEIGHT),
}
"""What drivers make of an arm in a posture, how the controller ends, and what it says."""


@pytest.mark.parametrize(("change", "posture", "mode", "said"), DRIVERS.values(), ids=DRIVERS)
def test_states_as_drivers_give_them_let_the_arm_be_held_or_are_named(change, posture, mode, said):
    controller = Controller(ARM, SETTINGS, 1.0 / RATE)
    observer = Observer(ARM, ObserverSettings(), ContactBudget(), 1.0 / RATE)
    model, random, sent = RobotModel(ARM), np.random.default_rng(0), []
    for tick in range(round(0.7 * RATE)):
        t, noise = tick / RATE, random.standard_normal((3, ARM.n))
        q, clock_ns = posture + 1e-5 * noise[0], round((1000.0 + t) * SECOND_NS)
        state = JointState(clock_ns, q, 1e-3 * noise[1], model.gravity_at(q) + 0.05 * noise[2])
        state = state if change is None else change(state, t)
        refused = ""
        report = observer.update(state)
        if report is not None and report.due:
            controller.hear(report.verdict, clock_ns)
        try:
            sent.append(controller.update(state, clock_ns))
        except InputError as error:
            refused = str(error)
    assert controller.mode is mode
    named = controller.stop_reason or refused or controller.not_vouched
    assert re.search(said, named) if said else not named
    torques = np.array([each for each in sent if each is not None]).reshape(-1, ARM.n)
    assert np.isfinite(torques).all() and (len(torques) > 0) is (mode is not Mode.WAITING)
    assert (np.abs(torques) <= CAP).all()
