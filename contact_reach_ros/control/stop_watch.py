"""Watches the arm during a compliant stop: it must come to rest, stay there, and end in the drive's brakes."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import REST_SPEED, Arm, Array
from contact_reach_ros.timing import NANOSECONDS, states_in

SPEED_DEBOUNCE = 3
"""Time above a permitted speed that counts, ms: a single wrong state stops nothing."""
SPEED_GAIN = 0.5
"""Increase in the speed of a joint since the stop with which the stop has failed, rad/s: damping only slows an arm that
the model carries."""
REST_WITHIN = 0.5
"""Time within which a stop must bring the arm to rest, s; otherwise all commands end, so that the drive's watchdog
takes over."""
CREEP = 0.01
"""Motion of a joint since it came to rest, too slow to be a hand's, with which the stop has failed, rad: about 1 cm at
the tip."""
BRAKE_AFTER = 2.0
"""Time after the arm came to rest at which all commands end, s, so that the drive's brakes hold it; until then a hand
can push the arm off what it hit."""

_BY_HAND = 2.0
"""An arm at rest that gets faster than so many times the speed of rest is moved by hand; slower, it creeps."""


class StopWatch:
    """Judges one compliant stop after the other, state by state.

    Attributes
    ----------
    is_over
        Whether the arm came to rest `BRAKE_AFTER` ago, so that the drive's brakes may have it.
    """

    def __init__(self, arm: Arm, period: float) -> None:
        """`period`: nominal time between joint states, s."""
        self._names = arm.joint_names
        self._debounce = states_in(SPEED_DEBOUNCE, period)
        self.begin()

    def begin(self) -> None:
        """Begin with another stop."""
        self.is_over = False
        self._began_ns: int | None = None
        self._rested_ns: int | None = None
        self._rest: Array | None = None
        """Where the arm came to rest, (n,), rad; None while it moves."""
        self._slowest: Array | None = None
        """Least speed of each joint since the stop, (n,), rad/s; None before the first state."""
        self._speeding_up = 0
        self._rest_is_due = True

    def look(self, q: Array, v: Array, clock_ns: int) -> str:
        """Take a state; returns why this stop has failed, empty while it has not.

        Parameters
        ----------
        q, v
            Joint positions (n,) rad and velocities (n,) rad/s.
        clock_ns
            Time of the watchdogs' clock.
        """
        if self._began_ns is None:
            self._began_ns = clock_ns
        speeds = np.abs(v)
        since = (clock_ns - self._began_ns) / NANOSECONDS
        # Each joint by itself: while one sinks, others slow down.
        self._slowest = speeds if self._slowest is None else np.minimum(self._slowest, speeds)
        gains = speeds - self._slowest
        joint = int(gains.argmax())
        self._speeding_up = self._speeding_up + 1 if gains[joint] > SPEED_GAIN else 0
        if self._speeding_up >= self._debounce:
            return f"in the stop {self._names[joint]} got faster, {speeds[joint]:.2f} rad/s after {1000 * since:.0f} ms"
        joint = int(speeds.argmax())
        speed = float(speeds[joint])
        if self._rest_is_due and since >= REST_WITHIN:
            self._rest_is_due = False
            if speed > REST_SPEED:
                return f"{self._names[joint]} still moves with {speed:.2f} rad/s {1000 * since:.0f} ms after the stop"
        return self._look_at_rest(q, speed, clock_ns)

    def _look_at_rest(self, q: Array, speed: float, clock_ns: int) -> str:
        if self._rest is not None:
            moved = np.abs(q - self._rest)
            joint = int(moved.argmax())
            if speed > _BY_HAND * REST_SPEED:
                self._rest = None
            elif moved[joint] > CREEP:
                return f"{self._names[joint]} has crept by {moved[joint]:.3f} rad since it came to rest"
        elif speed <= REST_SPEED:
            self._rest = q.copy()
            self._rested_ns = clock_ns if self._rested_ns is None else self._rested_ns
        if self._rested_ns is not None:
            self.is_over = clock_ns - self._rested_ns >= BRAKE_AFTER * NANOSECONDS
        return ""
