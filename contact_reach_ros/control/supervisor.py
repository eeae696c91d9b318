"""Supervision of the controller: the one state machine, and everything that stops the arm.

`Mode` lists the states, and `Event` what leads from one to another; docs/safety.md draws them.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from contact_reach_ros.arm import REST_SPEED, Arm, Array, check_rest
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.errors import InputError, StopCode, StopReason, Verdict, with_sequel
from contact_reach_ros.timing import NANOSECONDS, Debounce


class Mode(Enum):
    """States of the controller."""

    WAITING = "waiting"
    """Not started: nothing is commanded."""
    HOLDING = "holding"
    """No valid plan: the arm is held where it is."""
    TRACKING = "tracking"
    """A plan is in force."""
    YIELDING = "yielding"
    """Gives way to a contact that nothing explains, with the law of the stop, but not latched."""
    STOPPED = "stopped"
    """Latched compliant stop, see `PassiveStop`."""
    SILENT = "silent"
    """Latched, and nothing is commanded: the drive's watchdog holds the arm and closes the brakes."""


class Event(Enum):
    """What changes the state, in words: out of which states, and into which one. Others stay as they are."""

    START = "first valid state", (Mode.WAITING, Mode.HOLDING, Mode.TRACKING, Mode.YIELDING), Mode.HOLDING
    PLAN = "plan takes effect", (Mode.HOLDING,), Mode.TRACKING
    PLAN_ENDED = "plan runs out", (Mode.TRACKING,), Mode.HOLDING
    CONTACT = "contact without a plan, or too strong", (Mode.HOLDING, Mode.TRACKING), Mode.YIELDING
    FREED = "contact has ended", (Mode.YIELDING,), Mode.HOLDING
    STOP = "stop", (Mode.WAITING, Mode.HOLDING, Mode.TRACKING, Mode.YIELDING), Mode.STOPPED
    NO_REST = "stop brings no rest", (Mode.STOPPED,), Mode.SILENT
    RESTED = "stop has brought rest", (Mode.STOPPED,), Mode.SILENT
    RESET = "reset", (Mode.HOLDING, Mode.TRACKING, Mode.STOPPED, Mode.SILENT), Mode.HOLDING


RESET_ORDER = ("driver", "adapter", "observer", "controller")
"""Who is reset one after the other, by `Stack.reset` and `contact-reach reset`, as far as they are there: who can move
the arm comes last, and who sees it after those that may have to open the brakes for that."""

OBSERVER_TIMEOUT = 0.25
"""Silence of the observer that stops the arm, s: the controller's own watch sees the states meanwhile."""
SPEED_TOLERANCE = 1.3
"""Speed of a point of the arm that stops it, as a share of the permitted one."""
SPEED_DEBOUNCE = 3
"""Time above a permitted speed that counts, ms: a single wrong state stops nothing."""
GROWTH = 0.2
"""Speed by which a joint may get faster in a stop or while the arm gives way, as when a person pushes it, rad/s."""
REST_TIME = 0.3
"""Time at rest after which a stop ends in the drive's brakes, s: a rebound is over by then."""
STOP_TIME = 1.0
"""Time after the stop at which it ends in any case, s."""
LOST_TIME = 0.15
"""Time for which the acting torque may be unknown while the arm is held, s: brakes open in less."""
YIELD_TIME = 0.5
"""Time for which the arm gives way to a contact, s: if it has not ended then, the arm is stopped."""
OBSERVER, OWN_WATCH = "observer", "controller's own watch"
"""Who watches the arm: the observer's node, and the same computation in the controller's process, without a message in
between. Either one's stop counts."""

_BEYOND = 1e6
"""Sum of positions, rad, or velocities, rad/s, that no arm has."""

_GIVEN_UP = "nothing is commanded any more, the drive takes over"


class Supervisor:
    """Keeps the state, and watches those who watch the arm, its joints and the age of plans.

    Times `clock_ns` are integer nanoseconds of the watchdogs' clock, which must never jump.

    Attributes
    ----------
    mode
        The present state.
    longest_silence
        Of the observer since the last reset, s.
    """

    def __init__(self, arm: Arm, settings: SupervisionSettings, period: float = 0.001) -> None:
        """`period`: nominal time between joint states, s."""
        self.mode = Mode.WAITING
        self.longest_silence = 0.0
        self._arm = arm
        self._settings = settings
        self._limits = list(
            zip(arm.joint_names, arm.lower.tolist(), arm.upper.tolist(), arm.velocity_limits.tolist(), strict=True)
        )
        self._reason = self._sequel = ""
        self._fast_joint, self._fast_point = (Debounce(SPEED_DEBOUNCE, period) for _ in range(2))
        self._faster = Debounce(SPEED_DEBOUNCE, period)
        self._stopped_at = 0.0
        """Speed of the fastest joint when the stop or giving way began, rad/s."""
        self._since_ns: list[int] = []
        """When the stop or giving way began, and since when the arm has been at rest in a stop, if it is."""
        self._lost_ns: dict[str, int] = {}
        """When the acting torque was lost that was known before, by who says it."""
        self._verdicts: dict[str, Verdict] = {}
        """The last ones, by who gave them."""
        self._heard_ns: int | None = None
        """When the observer was heard last."""

    def happens(self, event: Event) -> bool:
        """Take an event; returns whether it changed the state."""
        _, states, after = event.value
        changes = self.mode in states and self.mode is not after
        if changes:
            self.mode = after
        if event is Event.RESET:
            self._reason = self._sequel = ""
            self._fast_joint.lasts(False)
            self._fast_point.lasts(False)
            self.longest_silence = 0.0
        return changes

    @property
    def torque_known(self) -> bool:
        """Whether the acting torque is known, as all who watch report it."""
        return all(verdict.torque_known for verdict in self._verdicts.values())

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched, compliant or not."""
        return self.mode in (Mode.STOPPED, Mode.SILENT)

    @property
    def is_passive(self) -> bool:
        """Whether the law of the stop is in force."""
        return self.mode in (Mode.STOPPED, Mode.YIELDING)

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped: the first reason, and why the stop was not enough; empty while it is not."""
        return with_sequel(self._reason, self._sequel)

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        if self.happens(Event.STOP):
            self._reason = reason
            self._since_ns = []

    def watch_stop(self, v: Array, clock_ns: int) -> None:
        """End a stop in the drive's brakes, as soon as the arm rests, or else after `STOP_TIME`.

        Where there are none, the hold goes on for an arm that rests. For one that does not, an adapter has the drive's
        own stop.
        """
        if self.mode is not Mode.STOPPED:
            return
        if not self._since_ns:
            self._begin(v, clock_ns)
        if self._grows(v) and self._can_end:
            self._give_up(f"{self._fastest(v)} gets faster in the stop")
        speed = float(np.abs(v).max())
        if speed > REST_SPEED:
            self._since_ns = self._since_ns[:1]
        elif len(self._since_ns) == 1:
            self._since_ns.append(clock_ns)
        began_ns, *rested = self._since_ns
        is_late = clock_ns - began_ns >= STOP_TIME * NANOSECONDS
        has_brakes = self._settings.drive_brakes
        if self.mode is not Mode.STOPPED:
            return
        if rested:
            if has_brakes and (is_late or clock_ns - rested[0] >= REST_TIME * NANOSECONDS):
                self.happens(Event.RESTED)
        elif is_late and self._can_end:
            self._give_up(f"{self._fastest(v)} still moves {STOP_TIME:g} s after the stop")

    def _begin(self, v: Array, clock_ns: int) -> None:
        self._since_ns, self._stopped_at = [clock_ns], float(np.abs(v).max())
        self._faster.lasts(False)

    def _grows(self, v: Array) -> bool:
        """Whether a joint gets faster: the law drives an arm only if states or commands are late."""
        return self._faster.lasts(float(np.abs(v).max()) > self._stopped_at + GROWTH)

    def _fastest(self, v: Array) -> str:
        joint = int(np.abs(v).argmax())
        return f"{self._arm.joint_names[joint]}, with {abs(v[joint]):.2f} rad/s,"

    @property
    def _can_end(self) -> bool:
        """Whether a drive to which nothing is commanded ends the motion."""
        return self._settings.drive_brakes or self._settings.adapter

    def watch_contact(self, v: Array, clock_ns: int) -> None:
        """Give way to a contact that no plan explains, or one that is too strong; stop if it does not end."""
        verdict = self._verdicts.get(OBSERVER, Verdict())
        if self.mode is not Mode.YIELDING:
            touched = verdict.excess or (self.mode is Mode.HOLDING and verdict.contact)
            if touched and self.happens(Event.CONTACT):
                self._begin(v, clock_ns)
        elif self._grows(v):
            self.stop(StopReason(StopCode.CONTACT, f"{self._fastest(v)} gets faster while the arm gives way"))
        elif clock_ns - self._since_ns[0] >= YIELD_TIME * NANOSECONDS:
            if verdict.contact:
                text = f"contact of {verdict.contact} has not ended although the arm gave way for {YIELD_TIME:g} s"
                self.stop(StopReason(StopCode.CONTACT, text))
            else:
                self.happens(Event.FREED)

    def watch_speed(self, share: float) -> None:
        """Stop when a joint or a point of the arm has been too fast for some states: `share` of its permitted speed."""
        if self._fast_point.lasts(share > SPEED_TOLERANCE):
            text = f"a joint or a point of the arm has {share:.2f} times its permitted speed (limits.body_speed)"
            self.stop(StopReason(StopCode.SPEED_LIMIT, text))

    def _give_up(self, why: str) -> None:
        if self.happens(Event.NO_REST):
            self._sequel = f"{why}; {_GIVEN_UP}" if why else _GIVEN_UP

    def check_reset(self, q: Array, v: Array, clock_ns: int) -> None:
        """Refuse a reset unless the arm rests within its limits and the observer is alive and not stopped.

        Raises `InputError` if one of these does not hold; the message says which.
        """
        check_start(self._arm, q, v)
        check_rest(v)
        if self.mode is Mode.YIELDING:
            raise InputError("the arm gives way to a contact: reset when that has ended")
        if reason := self._verdicts.get(OBSERVER, Verdict()).reason:
            raise InputError(f"the observer is stopped ({reason}): reset the observer first")
        if self._silence(clock_ns) > OBSERVER_TIMEOUT:
            raise InputError("the observer is silent: start it, then reset")

    def hear(self, name: str, verdict: Verdict, clock_ns: int) -> None:
        """Take a report of `OBSERVER` or `OWN_WATCH`; a reason in it, or a lost torque, stops an arm that has started.

        That of the observer is also its heartbeat. `clock_ns`: time of its arrival on the watchdogs' clock.
        """
        is_held = self.mode in (Mode.HOLDING, Mode.TRACKING, Mode.YIELDING)
        if verdict.torque_known or not is_held:
            self._lost_ns.pop(name, None)
        elif name in self._verdicts and self._verdicts[name].torque_known:
            self._lost_ns[name] = clock_ns
        self._verdicts[name] = verdict
        if name == OBSERVER:
            self._heard_ns = clock_ns
        if self.mode is Mode.WAITING:
            return
        if verdict.reason:
            self.stop(verdict.reason)
        if clock_ns - self._lost_ns.get(name, clock_ns) >= LOST_TIME * NANOSECONDS:
            text = "the acting torque is not known any more: the drive has closed its brakes, or its sensors failed"
            self.stop(StopReason(StopCode.BLIND, text))
        if verdict.distrust:
            self.stop(verdict.distrust)
            if self._can_end:
                self._give_up("" if verdict.distrust == self._reason else verdict.distrust)

    def not_vouched(self, clock_ns: int) -> str:
        """Why the arm must not be started: nobody watches it, or not as it should be; empty when it may."""
        if not self._settings.require_observer:
            return ""
        if self._heard_ns is None:
            return "nothing heard from the observer yet: start it, or set supervision.require_observer to false"
        if self._silence(clock_ns) > OBSERVER_TIMEOUT:
            return "the observer is silent: start it again"
        doubts = (verdict.reason or verdict.doubt for verdict in self._verdicts.values())
        doubt = next(filter(None, doubts), "")
        return f"the observer does not confirm the joint states: {doubt}" if doubt else ""

    def watch_observer(self, clock_ns: int) -> None:
        """Stop when the observer has been silent for too long; unless required, it may never have reported."""
        silence = self._silence(clock_ns)
        self.longest_silence = max(self.longest_silence, silence)
        if silence > OBSERVER_TIMEOUT:
            self.stop(StopReason(StopCode.OBSERVER_SILENT, f"observer silent for {1e3 * silence:.0f} ms"))

    def watch_joints(self, q: Array, v: Array) -> None:
        """Stop when a joint is beyond its position limit, or faster than permitted for some states in a row."""
        is_fast = False
        # For so few numbers a loop is faster than NumPy.
        for angle, speed, (name, lower, upper, limit) in zip(q.tolist(), v.tolist(), self._limits, strict=True):
            if not lower <= angle <= upper:
                beyond = lower if angle < lower else upper
                text = f"{name} at {angle:.3f} rad is beyond its position limit, {beyond:.3f} rad"
                self.stop(StopReason(StopCode.POSITION_LIMIT, text))
            is_fast = is_fast or not -limit <= speed <= limit
        if self._fast_joint.lasts(is_fast):
            limits = self._arm.velocity_limits
            joint = int(np.argmax(np.abs(v) / limits))
            name, speed, limit = self._arm.joint_names[joint], abs(v[joint]), limits[joint]
            text = f"{name} moves with {speed:.2f} rad/s, permitted {limit:.2f} rad/s"
            self.stop(StopReason(StopCode.SPEED_LIMIT, text))

    def watch_hold(self, held_for: float, had_plan: bool) -> None:
        """Stop when there has been no valid plan for too long after one; `held_for` is in s."""
        limit = self._settings.hold_limit
        if had_plan and held_for > limit:
            self.stop(StopReason(StopCode.NO_PLAN, f"no valid plan for {limit:g} s"))

    def _silence(self, clock_ns: int) -> float:
        """Time since the observer's last report, s; 0 before the first."""
        if self._heard_ns == 0:
            # It came before simulated time began, and counts from now on.
            self._heard_ns = clock_ns
        return 0.0 if self._heard_ns is None else (clock_ns - self._heard_ns) / NANOSECONDS


def check_start(arm: Arm, q: Array, v: Array) -> None:
    """Raise `InputError` unless the arm can be held in this state: finite, and within the position limits."""
    check_state(arm, q, v)
    beyond = (q < arm.lower) | (q > arm.upper)
    if beyond.any():
        names = [name for name, is_beyond in zip(arm.joint_names, beyond, strict=True) if is_beyond]
        angles = ", ".join(f"{angle:.4g}" for angle in q[beyond])
        raise InputError(
            f"joint_states: {', '.join(names)} beyond the position limit, at {angles} rad; move the arm back by hand, "
            "or let the driver send rad"
        )


def check_state(arm: Arm, q: Array, v: Array) -> None:
    """Raise `InputError` unless positions and velocities are a finite number for each joint."""
    for name, values in (("position", q), ("velocity", v)):
        if values.shape != (arm.n,) or values.dtype != float:
            raise InputError(
                f"joint_states: {name} has shape {values.shape}, type {values.dtype}; expected ({arm.n},), float64"
            )
        if not sum(map(abs, values.tolist())) < _BEYOND:
            raise InputError(f"joint_states: {name} = {values.tolist()}; expected finite values, in rad and s")
