"""Goals that move: successive messages as one goal with a velocity."""

from __future__ import annotations

import dataclasses

import numpy as np

from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import Target

_LONGEST_GAP_NS = NANOSECONDS
"""Time between two goals above which the second one is a new goal, ns: at 10 cm/s the arm would be 10 cm behind."""
_LARGEST_STEP = 0.06
"""Distance between two goals above which the second one is a new goal, m."""
_LEAST = 3
"""Goals from which on they are a stream: a second one may be a correction."""
_WINDOW_NS = NANOSECONDS * 3 // 10
"""Time of which the velocity is the mean, ns, or `_LEAST` goals if these take longer."""
_CLEAR = 4.0
"""Ratio of the velocity to its standard error, from the scatter of the goals, from which on it counts."""
_OVERDUE = 1.5
"""Times the longest gap in the window after which the stream has ended."""


class GoalStream:
    """The last goals, as long as each follows the one before soon and nearby.

    A straight line through them, by least squares, predicts where the goal is. Where it does not stand out from their
    scatter, and after the end of the stream, the goal rests where it was last.
    """

    def __init__(self) -> None:
        self._targets: list[Target] = []
        self._times_ns: list[int] = []
        self._line: tuple[np.ndarray, np.ndarray] | None = None
        """Position (3,) at the last goal's time, m, and velocity (3,), m/s; None while the goal rests."""

    def take(self, target: Target, time_ns: int) -> bool:
        """Take the next goal, given at a time, ns; returns whether it goes on with a stream."""
        gap_ns = time_ns - self._times_ns[-1] if self._times_ns else -1
        if not (0 <= gap_ns <= _LONGEST_GAP_NS and target.is_near(self._targets[-1], _LARGEST_STEP)):
            self.end()
        elif not gap_ns:
            # Several without a stamp that were handled at once: the last one counts.
            del self._targets[-1], self._times_ns[-1]
        self._targets.append(target)
        self._times_ns.append(time_ns)
        while len(self._times_ns) > _LEAST and time_ns - self._times_ns[0] > _WINDOW_NS:
            del self._targets[0], self._times_ns[0]
        self._line = self._fit() if len(self._times_ns) >= _LEAST else None
        return len(self._times_ns) >= _LEAST

    def end(self) -> None:
        """Forget all goals."""
        self._targets, self._times_ns, self._line = [], [], None

    def at(self, time_ns: int, now_ns: int) -> Target:
        """The last goal as it is at a time, ns, as far as it is known now; at least one has been taken."""
        target, last_ns = self._targets[-1], self._times_ns[-1]
        if self._line is None or now_ns - last_ns > _OVERDUE * np.diff(self._times_ns).max():
            return target
        position, velocity = self._line
        position = position + (time_ns - last_ns) / NANOSECONDS * velocity
        return dataclasses.replace(target, position=position, velocity=velocity)

    def _fit(self) -> tuple[np.ndarray, np.ndarray] | None:
        times = (np.array(self._times_ns) - self._times_ns[-1]) / NANOSECONDS
        positions = np.array([target.position for target in self._targets])
        offsets, center = times - times.mean(), positions.mean(axis=0)
        spread = float(offsets @ offsets)
        velocity = offsets @ positions / spread
        scatter = positions - center - np.outer(offsets, velocity)
        error = np.sqrt((scatter**2).sum() / (3 * (len(times) - 2)) / spread)
        if np.linalg.norm(velocity) <= _CLEAR * error:
            return None
        return center - times.mean() * velocity, velocity
