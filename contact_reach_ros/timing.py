"""Counting how long things take, cheaply enough for a 1 kHz loop."""

from __future__ import annotations

from collections.abc import Mapping

_BUCKETS = 20000

PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p999": 99.9}
"""Names of percentiles in diagnostics and reports."""


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
        for bucket, count in enumerate(self._counts[:-1]):
            seen += count
            if seen >= wanted:
                return min(float(self._bucket_us * (bucket + 1)), self.maximum_ns / 1000)
        return self.maximum_ns / 1000

    def summary(self) -> Mapping[str, float]:
        """Percentiles in µs, by the names that reports use."""
        return {name: self.percentile_us(percent) for name, percent in PERCENTILES.items()}
