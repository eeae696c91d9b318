"""The controller's own watch: an observer of the states that the controller answers, independent of other processes."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.control.supervisor import OWN_WATCH, Supervisor
from contact_reach_ros.errors import InputError, Verdict
from contact_reach_ros.timing import NANOSECONDS

if TYPE_CHECKING:
    from contact_reach_ros.observer.observer import Observer


class OwnWatch:
    """Shows states to an observer of the controller's own, and its verdicts to the supervisor.

    The observer takes at most one state in each of its periods, with the mean of the torques since the last.
    """

    def __init__(self, watcher: Observer, supervisor: Supervisor, period: float, watch_period: float) -> None:
        """`period`: nominal time between joint states, s; `watch_period`: that of the watcher."""
        self._watcher = watcher
        self._supervisor = supervisor
        # Half a period less for the jitter of stamps.
        self._step_ns = round((watch_period - 0.5 * period) * NANOSECONDS) if watch_period > period else 0
        """Least time between two of the watcher's states."""
        self._shown_ns: int | None = None
        """Stamp of the watcher's last new state; None before the first."""
        self._last_ns = 0
        """Stamp of the last new state."""
        self._shown_clock_ns = 0
        """When the watcher's last new state was shown, on the watchdogs' clock."""
        self._torque: Array | None = None
        """Mean of the torques (n,), N m, since the watcher's last state; None while there is none."""
        self._torques = 0
        """Number of torques in that mean, without those that are not known."""
        supervisor.hear(OWN_WATCH, Verdict(doubt="the controller's own watch has seen nothing yet"), 0)

    def see(self, state: JointState, started: bool, clock_ns: int) -> None:
        """Take a state, old ones included; `started`: whether the arm is commanded."""
        stamp_ns, q, v, torque = state
        shown_ns, step_ns = self._shown_ns, stamp_ns - self._last_ns
        if shown_ns is None or step_ns > 0:
            self._last_ns = stamp_ns
            self._add(torque)
            if shown_ns is not None and stamp_ns < shown_ns + self._step_ns:
                return
            state = JointState(stamp_ns, q, v, self._torque)
        elif step_ns == 0:
            # The watcher counts states that come again, but may not have seen the first one.
            state = JointState(shown_ns, q, v, torque)
        report = self._watcher.update(state)
        if report is None:
            return
        if step_ns or shown_ns is None:
            # Also when the clock was set back, and the watcher has agreed to that.
            self._shown_ns = self._last_ns = stamp_ns
            self._shown_clock_ns = clock_ns
            self._torque, self._torques = None, 0
        if not report.due:
            return
        self._supervisor.hear(OWN_WATCH, report.verdict, clock_ns)
        if report.verdict.reason and not started:
            # Before the start there is nothing to stop: what has to be reset by hand is latched by the observer alone.
            with suppress(InputError):
                self._watcher.reset(0.0)

    def reset(self, clock_ns: int) -> None:
        """Release what the watch has latched, if anything.

        Raises `InputError` if the arm moves or is still pushed, or what the watch knows of it is too old.
        """
        self._watcher.reset((clock_ns - self._shown_clock_ns) / NANOSECONDS)
        self._supervisor.hear(OWN_WATCH, self._watcher.report().verdict, clock_ns)

    def _add(self, torque: Array | None) -> None:
        """Take one more torque (n,), N m, into the mean; one that is not known counts only while none is."""
        # A sum is finite exactly when every summand is.
        if torque is None or not math.isfinite(sum(torque.tolist())):
            if self._torques == 0:
                self._torque = torque
            return
        self._torques += 1
        if self._torques == 1 or self._torque is None:
            self._torque = torque
        else:
            # In this form the mean of equal torques is exact: a sensor that is stuck stays recognisable.
            self._torque = self._torque + (torque - self._torque) / self._torques
