"""Histograms of durations, and detection of old messages by their stamps, cheap enough for a 1 kHz loop."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from contact_reach_ros.units import NANOSECONDS

PERIOD = 0.001
"""Nominal time between joint states, s."""

PERIOD_NS = 1_000_000
"""The same in ns."""

PAUSE = 0.1
"""Time without joint states after which nothing that was before them holds, s: the arm may be anywhere."""

GAP_PERIODS = 3
"""A step between states of more than so many periods is a gap, over which nothing is known."""

GAPS_IN_A_ROW = 5
"""So many mean that whoever reads the states is blind."""

_BUCKETS = 20000
_FINE, _COARSE = 200, 200
"""`Histogram.counts` reports so many buckets one by one, and later ones in groups of so many."""

PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
"""Names of percentiles in diagnostics and reports."""


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


class RateCheck:
    """Compares the stamps of joint states with the nominal rate, over about the last second.

    Attributes
    ----------
    steps
        Steps from state to state that were taken into account, at most those of a second.
    mean_ns, jitter_ns
        Mean step, and mean difference from the nominal one, ns.
    late_share
        Share of the steps that were longer than one and a half periods.
    longest_ns
        Longest step of the last `steps`, slowly forgotten, ns.
    """

    TOLERANCE = 0.5
    """How far the mean step may be from the nominal one, as a share of it."""
    _LEAST = 50
    """Steps without which nothing can be concluded."""

    def __init__(self, period: float) -> None:
        """`period`: nominal time between states, s."""
        self.steps = 0
        self.mean_ns = self.longest_ns = period * NANOSECONDS
        self.jitter_ns = self.late_share = 0.0
        self._period_ns = period * NANOSECONDS
        self._window = max(self._LEAST, round(1.0 / period))
        self._stamp_ns: int | None = None

    def update(self, stamp_ns: int) -> None:
        """Take the stamp of a new state, ns; pauses and steps backwards are no steps."""
        previous, self._stamp_ns = self._stamp_ns, stamp_ns
        if previous is None or not 0 < stamp_ns - previous <= max(PAUSE * NANOSECONDS, 5 * self._period_ns):
            return
        step = stamp_ns - previous
        self.steps = min(self.steps + 1, self._window)
        share = 1.0 / self.steps
        self.mean_ns += share * (step - self.mean_ns)
        self.jitter_ns += share * (abs(step - self._period_ns) - self.jitter_ns)
        self.late_share += share * ((step > 1.5 * self._period_ns) - self.late_share)
        self.longest_ns = max(step, self.longest_ns + share * (self._period_ns - self.longest_ns))

    def mismatch(self, least: int = _LEAST) -> str:
        """In what way the states do not come at the nominal rate; empty when they do, or before `least` steps."""
        if self.steps < least or abs(self.mean_ns / self._period_ns - 1.0) <= self.TOLERANCE:
            return ""
        found, nominal = NANOSECONDS / self.mean_ns, NANOSECONDS / self._period_ns
        return (
            f"joint states come at {found:.0f} Hz, expected {nominal:.0f} Hz: set the parameter state_rate of all "
            "nodes to the driver's"
        )

    def summary(self) -> Mapping[str, float]:
        """Values for diagnostics."""
        return {
            "joint states Hz": NANOSECONDS / self.mean_ns if self.steps else float("nan"),
            "joint states late share": self.late_share,
            "joint states jitter us": self.jitter_ns / 1000.0,
        }


class Histogram:
    """Histogram of durations in 20,000 equal buckets; longer ones share one more, and the longest is kept exactly.

    Parameters
    ----------
    bucket_us
        Width of a bucket, µs: 5 reaches to 100 ms, 100 to 2 s.
    """

    def __init__(self, bucket_us: int = 5) -> None:
        self._bucket_us = bucket_us
        self._counts = [0] * (_BUCKETS + 1)
        self.count = 0
        self.maximum_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration in ns; one below zero, from a clock that was set back, counts as zero."""
        bucket = max(duration_ns, 0) // (1000 * self._bucket_us)
        self._counts[bucket if bucket < _BUCKETS else _BUCKETS] += 1
        self.count += 1
        if duration_ns > self.maximum_ns:
            self.maximum_ns = duration_ns

    def percentile_us(self, percent: float) -> float:
        """Upper edge of the bucket that holds the percentile, µs; NaN without durations."""
        if self.count == 0:
            return float("nan")
        wanted, seen = percent / 100.0 * self.count, 0
        for bucket, count in enumerate(itertools.islice(self._counts, _BUCKETS)):
            seen += count
            if seen >= wanted:
                return min(float(self._bucket_us * (bucket + 1)), self.maximum_ns / 1000)
        return self.maximum_ns / 1000

    def counts(self) -> dict[int, int]:
        """Counts of durations by upper edge, µs; the first 200 buckets one by one, later ones in groups of 200.

        Durations beyond all buckets are counted at twice the last edge.
        """
        found: dict[int, int] = {}
        left = self.count
        for bucket, count in enumerate(self._counts):
            if count:
                last = bucket if bucket < _FINE else bucket // _COARSE * _COARSE + _COARSE - 1
                edge = self._bucket_us * (last + 1 if bucket < _BUCKETS else 2 * _BUCKETS)
                found[edge] = found.get(edge, 0) + count
                left -= count
                if left <= 0:
                    break
        return found

    def summary(self) -> Mapping[str, float]:
        """Percentiles in µs, by the names that reports use."""
        return {name: self.percentile_us(percent) for name, percent in PERCENTILES.items()}


def write_counts(counts: Mapping[int, int]) -> str:
    """Counts by upper edge in µs as text, for diagnostics: 'edge:count edge:count ...'."""
    return " ".join(f"{edge}:{count}" for edge, count in counts.items())


def read_counts(text: str) -> dict[int, int]:
    """Parse what `write_counts` wrote."""
    return {int(edge): int(count) for edge, _, count in (entry.partition(":") for entry in text.split())}


def counts_between(first: Mapping[int, int], last: Mapping[int, int]) -> dict[int, int]:
    """Counts added between `first` and `last`, by upper edge in µs."""
    grown = {edge: count - first.get(edge, 0) for edge, count in sorted(last.items())}
    return {edge: count for edge, count in grown.items() if count > 0}


def percentiles_us(counts: Mapping[int, int]) -> dict[str, float]:
    """Percentiles as in `Histogram.summary`, from counts by upper edge in µs; NaN without any."""
    total = sum(counts.values())
    found = dict.fromkeys(PERCENTILES, float("nan"))
    for name, percent in PERCENTILES.items():
        seen = 0
        for edge, count in sorted(counts.items()):
            seen += count
            if seen >= percent / 100.0 * total:
                found[name] = float(edge)
                break
    return found
