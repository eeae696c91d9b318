"""Supervision of the controller: the one state machine, and everything that stops the arm.

The states and what leads from one to another are `TRANSITIONS`; docs/safety.md shows them as a picture.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.settings import SupervisionSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


class Mode(Enum):
    """What the controller does."""

    WAITING = "waiting"
    """Not started: nothing is commanded."""
    HOLDING = "holding"
    """No valid plan: the arm is held where it is."""
    TRACKING = "tracking"
    """A plan is in force."""
    STOPPED = "stopped"
    """Latched compliant stop: no stiffness, damping and gravity only."""
    SILENT = "silent"
    """Latched, and nothing is commanded: the drive's watchdog holds the arm and closes the brakes."""


class Event(Enum):
    """What can happen."""

    START = "first valid state"
    PLAN = "plan takes effect"
    PLAN_ENDED = "plan runs out"
    STOP = "stop"
    NO_REST = "stop brings no rest"
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
    (Mode.STOPPED, Event.RESET): Mode.HOLDING,
    (Mode.SILENT, Event.RESET): Mode.HOLDING,
}
"""The state that an event leads to; an event that is not listed for a state changes nothing there."""

_PAUSE_NS = 5_000_000
"""Ticks further apart than this show that the controller itself was held up."""


_GIVEN_UP = "nothing is commanded any more, the drive takes over"


class Supervisor:
    """Keeps the state, and watches plan age, observer and joints.

    Times `clock_ns` are integer nanoseconds of the watchdogs' clock, which must never jump.

    Attributes
    ----------
    mode
        The state.
    """

    def __init__(self, settings: SupervisionSettings) -> None:
        self.mode = Mode.WAITING
        self._settings = settings
        self._first_reason = ""
        self._escalation = ""
        self._stopped_ns: int | None = None
        self._slowest = math.inf
        self._speeding_up = 0
        self._rest_is_due = False
        self._speed_limits = settings.velocity_share * np.array(iiwa14.VELOCITY_LIMITS)
        self._speed_list = self._speed_limits.tolist()
        self._speeding = 0
        self._observer_ns: int | None = None
        self._observer_stopped = ""
        self._clock_ns: int | None = None

    def happens(self, event: Event) -> bool:
        """Take an event other than a stop; returns whether it changed the state."""
        before = self.mode
        self.mode = TRANSITIONS.get((before, event), before)
        if event is Event.RESET:
            self._first_reason = self._escalation = ""
            self._speeding = 0
        return self.mode is not before

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched, compliant or not."""
        return self.mode in (Mode.STOPPED, Mode.SILENT)

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped: the first reason, and why the stop was not enough; empty while it is not."""
        return f"{self._first_reason}; {self._escalation}" if self._escalation else self._first_reason

    def stop(self, reason: str) -> None:
        """Latch the compliant stop; the first reason is kept."""
        if not self.stopped:
            self.mode = TRANSITIONS[self.mode, Event.STOP]
            self._first_reason = reason
            self._stopped_ns, self._slowest, self._speeding_up, self._rest_is_due = None, math.inf, 0, True

    def watch_stop(self, v: Array, clock_ns: int) -> None:
        """Give up the compliant stop when it does not bring the arm to rest in time, or the arm gets faster in it.

        The arm may be moved slowly by hand once it has rested.
        """
        if self.mode is not Mode.STOPPED:
            return
        if self._stopped_ns is None:
            self._stopped_ns = clock_ns
        settings = self._settings
        speeds = np.abs(v)
        speed = float(speeds.max())
        self._slowest = min(self._slowest, speed)
        self._speeding_up = self._speeding_up + 1 if speed > self._slowest + settings.stop_speed_gain else 0
        name = iiwa14.JOINT_NAMES[int(speeds.argmax())]
        since = (clock_ns - self._stopped_ns) / NANOSECONDS
        if self._speeding_up >= settings.velocity_debounce:
            self._escalate(f"in the stop {name} got faster, {speed:.2f} rad/s after {1000 * since:.0f} ms")
        elif since >= settings.rest_within and self._rest_is_due:
            self._rest_is_due = False
            if speed > settings.reset_velocity:
                self._escalate(f"{name} still moves with {speed:.2f} rad/s {1000 * since:.0f} ms after the stop")

    def _escalate(self, why: str) -> None:
        if self.happens(Event.NO_REST):
            self._escalation = f"{why}; {_GIVEN_UP}" if why else _GIVEN_UP

    def check_reset(self, q: Array, v: Array, clock_ns: int) -> None:
        """Refuse a reset unless the arm rests within its limits and the observer lives and is content.

        Raises
        ------
        InputError
            With what is in the way.
        """
        check_start(q, v)
        speed = float(np.abs(v).max())
        limit = self._settings.reset_velocity
        if not speed <= limit:
            raise InputError(f"the arm moves with {speed:.3f} rad/s; reset needs at most {limit:g} rad/s: wait for it")
        if self._observer_stopped:
            raise InputError(f"the observer is stopped ({self._observer_stopped}): reset the observer first")
        if self._observer_silence(clock_ns) is not None:
            raise InputError("the observer is silent: start it, then reset")

    def observer_report(self, stopped_because: str, clock_ns: int, distrust: str = "") -> None:
        """Take the observer's sign of life; a non-empty reason stops the arm.

        `distrust`: what is wrong with the joint states or the model, on which a compliant stop would rely, too.
        """
        self._observer_ns = clock_ns
        self._observer_stopped = stopped_because
        if stopped_because:
            self.stop(stopped_because)
        if distrust:
            self.stop(distrust)
            self._escalate("" if distrust == self._first_reason else distrust)

    def watch_observer(self, clock_ns: int) -> None:
        """Stop when the observer has been silent for too long; one that was never heard of is not waited for."""
        pause_ns = 0 if self._clock_ns is None else clock_ns - self._clock_ns
        self._clock_ns = clock_ns
        if self._observer_ns is not None and pause_ns > _PAUSE_NS:
            # This process was held up itself, and what the observer said meanwhile is still to be read.
            self._observer_ns += pause_ns
        silence = self._observer_silence(clock_ns)
        if silence is not None:
            self.stop(f"observer silent for {1000 * silence:.0f} ms")

    def watch_joints(self, q: Array, v: Array) -> None:
        """Stop when a joint is beyond its position limit, or faster than permitted for some states in a row."""
        # For seven numbers a loop is faster than NumPy.
        for index, (angle, limit) in enumerate(zip(q.tolist(), iiwa14.POSITION_LIMITS, strict=True)):
            if not -limit <= angle <= limit:
                self.stop(
                    f"{iiwa14.JOINT_NAMES[index]} at {angle:.3f} rad is beyond its position limit, {limit:.3f} rad"
                )
        for speed, limit in zip(v.tolist(), self._speed_list, strict=True):
            if not -limit <= speed <= limit:
                break
        else:
            self._speeding = 0
            return
        self._speeding += 1
        if self._speeding >= self._settings.velocity_debounce:
            joint = int(np.argmax(np.abs(v) / self._speed_limits))
            self.stop(
                f"{iiwa14.JOINT_NAMES[joint]} moves with {abs(v[joint]):.2f} rad/s, permitted "
                f"{self._speed_limits[joint]:.2f} rad/s"
            )

    def watch_hold(self, held_for: float, had_plan: bool) -> None:
        """Stop when there has been no valid plan for too long, s, after one."""
        limit = self._settings.hold_limit
        if had_plan and held_for > limit:
            self.stop(f"no valid plan for {limit:g} s")

    def _observer_silence(self, clock_ns: int) -> float | None:
        """Seconds of silence when they exceed the limit, else None."""
        if self._observer_ns is None:
            return None
        silence = (clock_ns - self._observer_ns) / NANOSECONDS
        return silence if silence > self._settings.observer_timeout else None


def check_start(q: Array, v: Array) -> None:
    """Raise `InputError` unless the arm can be held in this state: finite, and within the position limits."""
    check_state(q, v)
    beyond = np.abs(q) > np.array(iiwa14.POSITION_LIMITS)
    if beyond.any():
        names = [name for name, is_beyond in zip(iiwa14.JOINT_NAMES, beyond, strict=True) if is_beyond]
        raise InputError(f"joint_states: {', '.join(names)} beyond the position limit; move the arm back by hand")


def check_state(q: Array, v: Array) -> None:
    """Raise `InputError` unless positions and velocities are seven finite numbers each."""
    for name, values in (("position", q), ("velocity", v)):
        if values.shape != (iiwa14.N_JOINTS,) or values.dtype != float:
            raise InputError(
                f"joint_states: {name} has shape {values.shape}, type {values.dtype}; "
                f"expected ({iiwa14.N_JOINTS},), float64"
            )
        # A sum is finite exactly when no summand is NaN or infinite (opposite infinities make NaN).
        if not math.isfinite(sum(values.tolist())):
            raise InputError(f"joint_states: {name} = {values.tolist()}; expected finite values")
