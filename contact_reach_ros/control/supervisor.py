"""Supervision of the controller: the one state machine, and everything that stops the arm.

`TRANSITIONS` lists the states and what leads from one to another; docs/safety.md draws them.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from contact_reach_ros.arm import REST_SPEED, Arm, Array, check_rest
from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.errors import InputError, StopCode, StopReason, Verdict, is_missing_states, with_sequel
from contact_reach_ros.timing import NANOSECONDS, states_in


class Mode(Enum):
    """States of the controller."""

    WAITING = "waiting"
    """Not started: nothing is commanded."""
    HOLDING = "holding"
    """No valid plan: the arm is held where it is."""
    TRACKING = "tracking"
    """A plan is in force."""
    STOPPED = "stopped"
    """Latched compliant stop, see `PassiveStop`."""
    SILENT = "silent"
    """Latched, and nothing is commanded: the drive's watchdog holds the arm and closes the brakes."""


class Event(Enum):
    """Events that can change the state."""

    START = "first valid state"
    PLAN = "plan takes effect"
    PLAN_ENDED = "plan runs out"
    STOP = "stop"
    NO_REST = "stop brings no rest"
    RESTED = "stop has brought rest"
    RESET = "reset"


TRANSITIONS = {
    (Mode.WAITING, Event.START): Mode.HOLDING,
    (Mode.WAITING, Event.STOP): Mode.STOPPED,
    (Mode.HOLDING, Event.START): Mode.HOLDING,
    (Mode.HOLDING, Event.PLAN): Mode.TRACKING,
    (Mode.HOLDING, Event.STOP): Mode.STOPPED,
    (Mode.HOLDING, Event.RESET): Mode.HOLDING,
    (Mode.TRACKING, Event.START): Mode.HOLDING,
    (Mode.TRACKING, Event.PLAN_ENDED): Mode.HOLDING,
    (Mode.TRACKING, Event.STOP): Mode.STOPPED,
    (Mode.TRACKING, Event.RESET): Mode.HOLDING,
    (Mode.STOPPED, Event.NO_REST): Mode.SILENT,
    (Mode.STOPPED, Event.RESTED): Mode.SILENT,
    (Mode.STOPPED, Event.RESET): Mode.HOLDING,
    (Mode.SILENT, Event.RESET): Mode.HOLDING,
}
"""The state that an event leads to; an event that is not listed for a state changes nothing."""

OBSERVER_TIMEOUT = 0.05
"""Silence of the observer that stops the arm, s: five of its heartbeats."""
OBSERVER_PATIENCE = 0.5
"""Silence of the observer that stops the arm while the controller watches itself, s: nothing is left unwatched, and it
may be a machine that is busy for a moment."""
_PAUSE_PERIODS = 5
"""Ticks further apart than so many periods mean that the controller itself was held up."""


SPEED_DEBOUNCE = 3
"""Time above a permitted speed that counts, ms: a single wrong state stops nothing."""
REST_TIME = 0.3
"""Time at rest after which a stop ends in the drive's brakes, s: a rebound is over by then."""
STOP_TIME = 1.0
"""Time after the stop at which it ends in any case, s."""
_GIVEN_UP = "nothing is commanded any more, the drive takes over"


class Supervisor:
    """Keeps the state, and watches plan age, observer and joints.

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
        self._arm = arm
        self._pause_ns = _PAUSE_PERIODS * round(period * NANOSECONDS)
        self._timeout_ns = max(round(OBSERVER_TIMEOUT * NANOSECONDS), self._pause_ns)
        self._patience_ns = max(round(OBSERVER_PATIENCE * NANOSECONDS), self._timeout_ns)
        self._velocity_debounce = states_in(SPEED_DEBOUNCE, period)
        self._settings = settings
        self._first_reason = ""
        self._escalation = ""
        self._stopped_ns: int | None = None
        self._rested_ns: int | None = None
        """Since when the stopped arm has been at rest; None while it moves."""
        self._speed_limits = arm.velocity_limits
        self._speed_list = arm.velocity_limits.tolist()
        self._position_limits = list(zip(arm.lower.tolist(), arm.upper.tolist(), strict=True))
        self._speeding = 0
        self._observer_ns: int | None = None
        self._verdict = Verdict()
        self._own: Verdict | None = None
        """Of the controller's own watch; None without one."""
        self._own_ns = 0
        self._missing_ns: int | None = None
        """Since when the observer has missed states; None while it sees them."""
        self._own_missing_ns: int | None = None
        """The same for the controller's own watch."""
        self.longest_silence = 0.0
        self._has_begun = self._is_early = False
        """Whether there was a joint state; and whether, in simulated time, the last report came before it."""
        self._has_forgiven = False
        """Whether a pause of this process was taken off the observer's silence; its next report permits another."""
        self._clock_ns: int | None = None

    def happens(self, event: Event) -> bool:
        """Take an event other than a stop; returns whether it changed the state."""
        before = self.mode
        self.mode = TRANSITIONS.get((before, event), before)
        if event is Event.RESET:
            self._first_reason = self._escalation = ""
            self._speeding = 0
            self.longest_silence = 0.0
        return self.mode is not before

    @property
    def torque_known(self) -> bool:
        """Whether the acting torque is known, as the observer and the controller's own watch report it."""
        return self._verdict.torque_known and (self._own is None or self._own.torque_known)

    @property
    def own_reason(self) -> str:
        """Why the controller's own watch stops the arm; empty while it does not, or without one."""
        return "" if self._own is None else self._own.reason

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched, compliant or not."""
        return self.mode in (Mode.STOPPED, Mode.SILENT)

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped: the first reason, and why the stop was not enough; empty while it is not."""
        return with_sequel(self._first_reason, self._escalation)

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        if not self.stopped:
            self.mode = TRANSITIONS[self.mode, Event.STOP]
            self._first_reason = reason
            self._stopped_ns = self._rested_ns = None

    def watch_stop(self, v: Array, clock_ns: int) -> None:
        """End a stop in the drive's brakes, as soon as the arm rests, or else after `STOP_TIME`.

        Where there are none, the hold goes on for an arm that rests. For one that does not, an adapter has the drive's
        own stop.
        """
        if self.mode is not Mode.STOPPED:
            return
        if self._stopped_ns is None:
            self._stopped_ns = clock_ns
        speed = float(np.abs(v).max())
        if speed > REST_SPEED:
            self._rested_ns = None
        elif self._rested_ns is None:
            self._rested_ns = clock_ns
        is_late = clock_ns - self._stopped_ns >= STOP_TIME * NANOSECONDS
        has_brakes = self._settings.drive_brakes
        if self._rested_ns is not None:
            if has_brakes and (is_late or clock_ns - self._rested_ns >= REST_TIME * NANOSECONDS):
                self.happens(Event.RESTED)
        elif is_late and (has_brakes or self._settings.adapter):
            joint = self._arm.joint_names[int(np.abs(v).argmax())]
            self._give_up(f"{joint} still moves with {speed:.2f} rad/s {STOP_TIME:g} s after the stop")

    def _give_up(self, why: str) -> None:
        if self.happens(Event.NO_REST):
            self._escalation = f"{why}; {_GIVEN_UP}" if why else _GIVEN_UP

    def check_reset(self, q: Array, v: Array, clock_ns: int) -> None:
        """Refuse a reset unless the arm rests within its limits and the observer is alive and not stopped.

        Raises `InputError` if one of these does not hold; the message says which.
        """
        check_start(self._arm, q, v)
        check_rest(v)
        if self._verdict.reason:
            raise InputError(f"the observer is stopped ({self._verdict.reason}): reset the observer first")
        if self._silent_for(clock_ns) > self._timeout_ns:
            raise InputError("the observer is silent: start it, then reset")

    def hear_observer(self, verdict: Verdict, clock_ns: int) -> None:
        """Take a report of the observer, which is also its heartbeat; a reason in it stops the arm once it has started.

        While the controller's own watch is healthy, missed states do not stop the arm: the observer's process was held
        up, and the states have been seen.

        `clock_ns`: time of its arrival on the watchdogs' clock.
        """
        self._observer_ns, self._has_forgiven = clock_ns, False
        self._is_early = clock_ns == 0 and not self._has_begun
        self._verdict = verdict
        self._missing_ns = _since(self._missing_ns, verdict, clock_ns)
        if not (self._may_miss(self._missing_ns, clock_ns) and self.own_vouches(clock_ns)):
            self._act_on(verdict)

    def hear_own(self, verdict: Verdict, clock_ns: int) -> None:
        """Take a report of the controller's own watch, which counts as much as the observer's.

        It may miss states for as long as the observer may, while the observer is healthy.
        """
        self._own, self._own_ns = verdict, clock_ns
        self._own_missing_ns = _since(self._own_missing_ns, verdict, clock_ns)
        if not (self._may_miss(self._own_missing_ns, clock_ns) and self._observer_vouches(clock_ns)):
            self._act_on(verdict)

    def _may_miss(self, missing_ns: int | None, clock_ns: int) -> bool:
        """Whether a watcher that has missed states since then may go on to."""
        return missing_ns is not None and clock_ns - missing_ns <= self._patience_ns

    def _act_on(self, verdict: Verdict) -> None:
        if self.mode is Mode.WAITING:
            return
        if verdict.reason:
            self.stop(verdict.reason)
        if verdict.distrust:
            self.stop(verdict.distrust)
            self._give_up("" if verdict.distrust == self._first_reason else verdict.distrust)

    def not_vouched(self, clock_ns: int) -> str:
        """Why the arm must not be started: nobody watches it, or not as it should be; empty when it may."""
        if not self._settings.require_observer:
            return ""
        self._has_begun = True
        if self._observer_ns is None or self._heard_before_time(clock_ns):
            return "nothing heard from the observer yet: start it, or set supervision.require_observer to false"
        if self._silent_for(clock_ns) > self._timeout_ns:
            return "the observer is silent: start it again"
        doubt = self._verdict.reason or self._verdict.doubt
        if self._own is not None:
            doubt = doubt or self._own.reason or self._own.doubt
        return f"the observer does not confirm the joint states: {doubt}" if doubt else ""

    def pass_time(self, clock_ns: int) -> None:
        """Note that a joint state has arrived, even one that is refused: this process is not held up."""
        self._heard_before_time(clock_ns)
        pause_ns = 0 if self._clock_ns is None else clock_ns - self._clock_ns
        self._clock_ns = clock_ns
        if pause_ns > self._pause_ns:
            # This process was held up itself, with its own watch, and has not yet read what the observer reported.
            self._own_ns += pause_ns
            if self._observer_ns is not None and not self._has_forgiven:
                self._observer_ns += pause_ns
                self._has_forgiven = True

    def wait(self) -> None:
        """Note that no joint states are taken for a while, which is no pause of this process."""
        self._clock_ns = None

    def watch_observer(self, clock_ns: int) -> None:
        """Stop when the observer has been silent for too long; unless required, it may never have reported.

        While the controller's own watch is healthy nothing goes unseen, and the observer may take longer.
        """
        self.pass_time(clock_ns)
        silence_ns = self._silent_for(clock_ns)
        self.longest_silence = max(self.longest_silence, silence_ns / NANOSECONDS)
        if silence_ns > (self._patience_ns if self.own_vouches(clock_ns) else self._timeout_ns):
            self.stop(StopReason(StopCode.OBSERVER_SILENT, f"observer silent for {silence_ns / 1e6:.0f} ms"))

    def watch_joints(self, q: Array, v: Array) -> None:
        """Stop when a joint is beyond its position limit, or faster than permitted for some states in a row."""
        # For so few numbers a loop is faster than NumPy.
        for index, (angle, (lower, upper)) in enumerate(zip(q.tolist(), self._position_limits, strict=True)):
            if not lower <= angle <= upper:
                limit = lower if angle < lower else upper
                name = self._arm.joint_names[index]
                text = f"{name} at {angle:.3f} rad is beyond its position limit, {limit:.3f} rad"
                self.stop(StopReason(StopCode.POSITION_LIMIT, text))
        for speed, limit in zip(v.tolist(), self._speed_list, strict=True):
            if not -limit <= speed <= limit:
                break
        else:
            self._speeding = 0
            return
        self._speeding += 1
        if self._speeding >= self._velocity_debounce:
            joint = int(np.argmax(np.abs(v) / self._speed_limits))
            speed, limit = abs(v[joint]), self._speed_limits[joint]
            text = f"{self._arm.joint_names[joint]} moves with {speed:.2f} rad/s, permitted {limit:.2f} rad/s"
            self.stop(StopReason(StopCode.SPEED_LIMIT, text))

    def watch_hold(self, held_for: float, had_plan: bool) -> None:
        """Stop when there has been no valid plan for too long after one; `held_for` is in s."""
        limit = self._settings.hold_limit
        if had_plan and held_for > limit:
            self.stop(StopReason(StopCode.NO_PLAN, f"no valid plan for {limit:g} s"))

    def _observer_vouches(self, clock_ns: int) -> bool:
        """Whether the observer, heard of not long ago, has nothing against the arm's motion."""
        heard = self._observer_ns is not None and self._silent_for(clock_ns) <= self._timeout_ns
        return heard and not self._verdict.reason and not self._verdict.doubt

    def own_vouches(self, clock_ns: int) -> bool:
        """Whether the controller's own watch, which is not late, has nothing against the arm's motion."""
        own = self._own
        return own is not None and not own.doubt and clock_ns - self._own_ns <= self._timeout_ns

    def _heard_before_time(self, clock_ns: int) -> bool:
        """Whether the observer's last report came before simulated time began; it counts from now on."""
        if not self._is_early:
            return False
        self._observer_ns, self._is_early = clock_ns, False
        return True

    def _silent_for(self, clock_ns: int) -> int:
        """Time since the observer's last report, ns; 0 before the first."""
        return 0 if self._observer_ns is None else clock_ns - self._observer_ns


def _since(missing_ns: int | None, verdict: Verdict, clock_ns: int) -> int | None:
    """Since when a watcher has missed states, after one more verdict; None if it sees them."""
    if not is_missing_states(verdict.reason):
        return None
    return clock_ns if missing_ns is None else missing_ns


def check_start(arm: Arm, q: Array, v: Array) -> None:
    """Raise `InputError` unless the arm can be held in this state: finite, and within the position limits."""
    check_state(arm, q, v)
    beyond = (q < arm.lower) | (q > arm.upper)
    if beyond.any():
        names = [name for name, is_beyond in zip(arm.joint_names, beyond, strict=True) if is_beyond]
        raise InputError(f"joint_states: {', '.join(names)} beyond the position limit; move the arm back by hand")


def check_state(arm: Arm, q: Array, v: Array) -> None:
    """Raise `InputError` unless positions and velocities are a finite number for each joint."""
    for name, values in (("position", q), ("velocity", v)):
        if values.shape != (arm.n,) or values.dtype != float:
            raise InputError(
                f"joint_states: {name} has shape {values.shape}, type {values.dtype}; expected ({arm.n},), float64"
            )
        # A sum is finite exactly when no summand is NaN or infinite (opposite infinities make NaN).
        if not math.isfinite(sum(values.tolist())):
            raise InputError(f"joint_states: {name} = {values.tolist()}; expected finite values")
