"""The quantities plotted over time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from contact_reach_ros.arrays import Array

_FIRST = ("time", "distance", "force")
_FORCE = _FIRST.index("force")

SPAN = 20.0
"""Time span of a plot, s."""

POINTS = 400
"""Greatest number of points in a curve."""


def joint_labels(joints: int) -> tuple[str, ...]:
    """Names of the joints' curves."""
    return tuple(f"A{number}" for number in range(1, joints + 1))


def quantities(joints: int) -> tuple[str, ...]:
    """Columns of the plotted tables.

    Time, s; distance to the goal, mm; largest contact force on one body, N; external torque of each joint, Nm; age of
    the plan, ms; two percentiles of a tick's round trip, µs.
    """
    return (*_FIRST, *joint_labels(joints), "plan age", "round trip p50", "round trip p99")


class History:
    """Plotted quantities over the last `SPAN` seconds, for an arm with `joints` joints."""

    def __init__(self, joints: int) -> None:
        self._columns = quantities(joints)[1:]
        self._rows: deque[tuple[float, ...]] = deque()

    def add(self, time: float, values: Mapping[str, float]) -> None:
        """Append the quantities known at a time, s, by name; a time before the last one clears the history."""
        if self._rows and time < self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, *(values.get(name, np.nan) for name in self._columns)))
        while self._rows[0][0] < time - SPAN:
            self._rows.popleft()

    def table(self) -> Array:
        """(n, `quantities`)."""
        return thinned(np.array(self._rows, float).reshape(-1, 1 + len(self._columns)))


def thinned(table: Array) -> Array:
    """At most `POINTS` rows of a table: the last of each group of rows, with the largest contact force in the group.

    Every peak of the force is kept, because it is compared with the permitted force.
    """
    if len(table) <= POINTS:
        return table
    size = -(-len(table) // POINTS)
    ends = np.arange(size - 1, len(table) + size - 1, size).clip(max=len(table) - 1)
    rows = table[ends].copy()
    padded = np.full(len(ends) * size, -np.inf)
    padded[: len(table)] = np.nan_to_num(table[:, _FORCE], nan=-np.inf)
    peaks = padded.reshape(-1, size).max(axis=1)
    rows[:, _FORCE] = np.where(np.isfinite(peaks), peaks, np.nan)
    return rows
