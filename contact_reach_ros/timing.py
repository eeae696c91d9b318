"""Ticks, percentiles of durations, and detection of old messages by their stamps, cheap enough for a 1 kHz loop."""

from __future__ import annotations

import math

import numpy as np

NANOSECONDS = 1_000_000_000
"""Nanoseconds per second."""

PERIOD = 0.001
"""Nominal time between joint states, s."""

PAUSE = 0.1
"""Time without joint states after which nothing that was before them holds, s: the arm may be anywhere."""

GAP_PERIODS = 3
"""A step between states of more than so many periods is a gap, over which nothing is known."""

_KEPT = 60_000
"""Number of durations from which percentiles are computed."""

PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9, "max": 100.0}
"""Names of percentiles in diagnostics and reports."""

_MOST_CATCH_UP_NS = 20_000_000
"""A process that is later than this stood still itself."""

_PATIENCE = 5
"""Older messages in a row after which the clock counts as set back."""


def states_in(milliseconds: int, period: float) -> int:
    """Number of states that arrive in a time, one every `period` seconds; at least two, or one in a millisecond."""
    return max(min(milliseconds, 2), round(milliseconds / (1000.0 * period)))


class Debounce:
    """Whether something has lasted for a time, counted in states."""

    def __init__(self, milliseconds: int, period: float) -> None:
        """`milliseconds`: the time, converted by `states_in`; `period`: of the states, s."""
        self._limit = states_in(milliseconds, period)
        self._states = 0

    def lasts(self, is_so: bool) -> bool:
        """Take whether it is so in the next state; returns whether it has been for long enough."""
        self._states = self._states + 1 if is_so else 0
        return self._states >= self._limit


class StampOrder:
    """Distinguishes new messages from old ones that arrive again, by their stamps.

    A message is new when its stamp is newer than all before. A few older ones in a row, without a new one among them,
    mean that the clock was set back; the next of them counts as new.

    Attributes
    ----------
    repeated, older
        Messages that were not new: with the newest stamp, and with an older one.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self.older = 0
        self._newest_ns: int | None = None
        self._older_ns = 0
        self._in_a_row = 0

    def is_new(self, stamp_ns: int) -> bool:
        """Take the stamp of a message, ns; returns whether the message is new."""
        newest_ns = self._newest_ns
        if newest_ns is None or stamp_ns > newest_ns:
            self._newest_ns, self._in_a_row = stamp_ns, 0
            return True
        if stamp_ns == newest_ns:
            self.repeated += 1
            return False
        # One old message that is repeated again and again does not mean that the clock was set back.
        if self._in_a_row == 0 or stamp_ns > self._older_ns:
            self._older_ns = stamp_ns
            self._in_a_row += 1
        if self._in_a_row > _PATIENCE:
            self._newest_ns, self._in_a_row = stamp_ns, 0
            return True
        self.older += 1
        return False


class Pace:
    """Counts ticks of the steady clock.

    Parameters
    ----------
    period_ns
        Time between ticks, ns.

    Attributes
    ----------
    next_ns
        When the next tick is due, ns.
    missed
        Ticks that came late by a period or more.
    stood_ns
        Time for which the robot has stood still because this process did, ns.
    """

    def __init__(self, period_ns: int) -> None:
        self.next_ns = 0
        self.missed = 0
        self.stood_ns = 0
        self._period_ns = period_ns

    def start(self, now_ns: int) -> None:
        """Let the first tick be due in a period."""
        self.next_ns = now_ns + self._period_ns

    def stand_still(self, now_ns: int) -> int:
        """After a long pause of this process, leave out ticks: the robot neither moves nor receives anything.

        Returns the time that is left out, ns, by which its stamps advance.
        """
        ticks = max((now_ns - self.next_ns - _MOST_CATCH_UP_NS) // self._period_ns, 0)
        self.missed += ticks
        self.next_ns += ticks * self._period_ns
        self.stood_ns += ticks * self._period_ns
        return ticks * self._period_ns

    def due(self, now_ns: int) -> int:
        """Number of ticks that are due: a real robot moves on, whether this process is on time or not."""
        late = max((now_ns - self.next_ns) // self._period_ns, 0)
        self.missed += late
        self.next_ns += (1 + late) * self._period_ns
        return 1 + late


class Durations:
    """The newest durations, a minute of them at 1 kHz."""

    def __init__(self) -> None:
        self._ns = np.zeros(_KEPT, np.int64)
        self._count = 0

    def add(self, duration_ns: int) -> None:
        """Keep one duration, ns; one below zero, from a clock that was set back, counts as zero."""
        self._ns[self._count % _KEPT] = max(duration_ns, 0)
        self._count += 1

    def summary(self) -> dict[str, float]:
        """Percentiles, µs, by their names in diagnostics and reports; NaN without durations."""
        # Another thread may add to them meanwhile. The first call of np.percentile would hold it up for milliseconds.
        ordered = np.sort(self._ns[: self._count])
        if not ordered.size:
            return dict.fromkeys(PERCENTILES, math.nan)
        last = ordered.size - 1
        return {name: float(ordered[round(percent / 100.0 * last)]) / 1000.0 for name, percent in PERCENTILES.items()}
