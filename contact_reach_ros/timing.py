"""Ticks, histograms of durations, and detection of old messages by their stamps, cheap enough for a 1 kHz loop."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

NANOSECONDS = 1_000_000_000
"""Nanoseconds per second."""

PERIOD = 0.001
"""Nominal time between joint states, s."""

PAUSE = 0.1
"""Time without joint states after which nothing that was before them holds, s: the arm may be anywhere."""

GAP_PERIODS = 3
"""A step between states of more than so many periods is a gap, over which nothing is known."""

GAPS_IN_A_ROW = 5
"""So many mean that the reader of the states is blind."""

_BITS = 7
"""Significant binary digits of the durations in a `Histogram`."""

PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
"""Names of percentiles in diagnostics and reports."""

_MOST_CATCH_UP_NS = 20_000_000
"""A process that is later than this stood still itself."""

_PATIENCE = 5
"""Older messages in a row after which the clock counts as set back."""


def states_in(milliseconds: int, period: float) -> int:
    """Number of states that arrive in a time, one every `period` seconds; at least two, or one in a millisecond."""
    return max(min(milliseconds, 2), round(milliseconds / (1000.0 * period)))


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


class Histogram:
    """Histogram of durations in buckets of 1 µs up to 0.1 ms, and of 1.6 % beyond.

    Attributes
    ----------
    counts
        Counts of durations by upper edge, µs.
    maximum_ns
        The longest duration, exactly.
    """

    def __init__(self) -> None:
        self.counts: Counter[int] = Counter()
        self.maximum_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration in ns; one below zero, from a clock that was set back, counts as zero."""
        whole_us = max(duration_ns, 0) // 1000
        shift = max(0, whole_us.bit_length() - _BITS)
        self.counts[((whole_us >> shift) + 1) << shift] += 1
        self.maximum_ns = max(duration_ns, self.maximum_ns)

    def summary(self) -> Mapping[str, float]:
        """`percentiles_us`, none longer than the longest duration."""
        return {name: min(value, self.maximum_ns / 1000) for name, value in percentiles_us(self.counts).items()}


def write_counts(counts: Mapping[int, int]) -> str:
    """Counts by upper edge in µs as text, for diagnostics: 'edge:count edge:count ...'."""
    return " ".join(f"{edge}:{count}" for edge, count in sorted(counts.items()))


def read_counts(text: str) -> Counter[int]:
    """Parse what `write_counts` wrote."""
    return Counter({int(edge): int(count) for edge, _, count in (entry.partition(":") for entry in text.split())})


def percentiles_us(counts: Mapping[int, int]) -> dict[str, float]:
    """Upper edges of the buckets that hold the percentiles, µs, by the names that reports use; NaN without counts."""
    # Another thread may add to them meanwhile.
    entries = sorted(counts.items())
    if not entries:
        return dict.fromkeys(PERCENTILES, math.nan)
    total = np.cumsum([count for _, count in entries])
    wanted = {name: percent / 100.0 * total[-1] for name, percent in PERCENTILES.items()}
    return {name: float(entries[int(np.searchsorted(total, count))][0]) for name, count in wanted.items()}
