"""Counting how long things take, and telling new messages from old ones, cheaply enough for a 1 kHz loop."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

_BUCKETS = 20000
_FINE, _COARSE = 200, 200
"""So many buckets are told one by one; later ones so many together."""

PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
"""Names of percentiles in diagnostics and reports."""


_PATIENCE = 5
"""Older messages, one after the other, that show a clock that was set back."""


class StampOrder:
    """Tells new messages from old ones that come again, by their stamps.

    A message is new when its stamp is newer than all before. Older ones that follow each other without a new one among
    them are new as well, after a few: the clock was set back.

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
        """Take the stamp of a message, ns."""
        newest_ns = self._newest_ns
        if newest_ns is None or stamp_ns > newest_ns:
            self._newest_ns, self._in_a_row = stamp_ns, 0
            return True
        if stamp_ns == newest_ns:
            self.repeated += 1
            return False
        # One that is repeated again and again shows no clock that goes on.
        if self._in_a_row == 0 or stamp_ns > self._older_ns:
            self._older_ns = stamp_ns
            self._in_a_row += 1
        if self._in_a_row > _PATIENCE:
            self._newest_ns, self._in_a_row = stamp_ns, 0
            return True
        self.older += 1
        return False


class Histogram:
    """Durations in 20,000 equal buckets; longer ones share one more, and the longest is kept exactly.

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
        """How many durations there were, by an upper edge in µs; the first 200 buckets apart, later ones 200 together.

        What is longer than all buckets has twice the last one's edge.
        """
        told: dict[int, int] = {}
        left = self.count
        for bucket, count in enumerate(self._counts):
            if count:
                last = bucket if bucket < _FINE else bucket // _COARSE * _COARSE + _COARSE - 1
                edge = self._bucket_us * (last + 1 if bucket < _BUCKETS else 2 * _BUCKETS)
                told[edge] = told.get(edge, 0) + count
                left -= count
                if left <= 0:
                    break
        return told

    def summary(self) -> Mapping[str, float]:
        """Percentiles in µs, by the names that reports use."""
        return {name: self.percentile_us(percent) for name, percent in PERCENTILES.items()}


def write_counts(counts: Mapping[int, int]) -> str:
    """Counts by upper edge in µs as text, for diagnostics: 'edge:count edge:count ...'."""
    return " ".join(f"{edge}:{count}" for edge, count in counts.items())


def read_counts(text: str) -> dict[int, int]:
    """What `write_counts` wrote."""
    return {int(edge): int(count) for edge, _, count in (entry.partition(":") for entry in text.split())}


def counts_between(first: Mapping[int, int], last: Mapping[int, int]) -> dict[int, int]:
    """What was counted after `first` and before `last`, by upper edge in µs."""
    grown = {edge: count - first.get(edge, 0) for edge, count in sorted(last.items())}
    return {edge: count for edge, count in grown.items() if count > 0}


def percentiles_us(counts: Mapping[int, int]) -> dict[str, float]:
    """The same percentiles as `Histogram.summary`, of counts by upper edge in µs; NaN without any."""
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
