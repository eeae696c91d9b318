"""The quantities that are plotted over time."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot import iiwa14

Array = NDArray[np.float64]

JOINTS = tuple(f"A{number}" for number in range(1, iiwa14.N_JOINTS + 1))

QUANTITIES = ("distance", "force", *JOINTS, "plan age", "round trip p50", "round trip p99")
"""Distance to the goal, mm; largest contact force on one body, N; external torques, Nm; ms; µs twice."""

SPAN = 20.0
"""Time that a plot shows, s."""

POINTS = 400
"""Of a curve, at most."""


class History:
    """Rows of the plotted quantities over the last `SPAN` seconds."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, ...]] = deque()

    def add(self, time: float, **values: float) -> None:
        """Append what is known at a time, s; keys are those of `QUANTITIES` with '_' for ' '.

        A time before the last one, as after a restart, begins anew.
        """
        if self._rows and time < self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, *(values.get(name.replace(" ", "_"), np.nan) for name in QUANTITIES)))
        while self._rows[0][0] < time - SPAN:
            self._rows.popleft()

    def table(self) -> Array:
        """(n, 1 + quantities): time and `QUANTITIES`."""
        return thinned(np.array(self._rows, float).reshape(-1, 1 + len(QUANTITIES)))


def thinned(table: Array) -> Array:
    """At most `POINTS` rows of a table: of each group of rows the last, with the largest contact force of the group.

    A short peak of the force must not get lost, since it is compared with the permitted one.
    """
    if len(table) <= POINTS:
        return table
    size = -(-len(table) // POINTS)
    ends = np.arange(size - 1, len(table) + size - 1, size).clip(max=len(table) - 1)
    rows = table[ends].copy()
    force = 1 + QUANTITIES.index("force")
    padded = np.full(len(ends) * size, -np.inf)
    padded[: len(table)] = np.nan_to_num(table[:, force], nan=-np.inf)
    peaks = padded.reshape(-1, size).max(axis=1)
    rows[:, force] = np.where(np.isfinite(peaks), peaks, np.nan)
    return rows
