"""The robot's clock in a bag."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.bags.columns import Column
from contact_reach_ros.timing import NANOSECONDS


class Clock:
    """Places messages on the robot's clock, in s since its first joint state.

    Attributes
    ----------
    origin_ns :
        Stamp of the first joint state, ns.
    """

    def __init__(self, states: Column) -> None:
        stamped = states.stamp_ns != 0
        received, stamps = states.log_ns[stamped], states.stamp_ns[stamped]
        if len(stamps):
            self._received_0, self.origin_ns, self._last_ns = int(received[0]), int(stamps[0]), int(stamps[-1])
        else:
            self._received_0 = self.origin_ns = self._last_ns = int(states.log_ns[0]) if len(states) else 0
        self._received = (received - self._received_0) / NANOSECONDS
        self._stamps = (stamps - self.origin_ns) / NANOSECONDS

    def covers(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether stamps, ns, lie between those of the first joint state and of the last one."""
        return np.asarray((stamps_ns >= self.origin_ns) & (stamps_ns <= self._last_ns))

    def of_stamps(self, column: Column) -> np.ndarray:
        """By the stamps in the headers, or by reception where they are zero."""
        times = (column.stamp_ns - self.origin_ns) / NANOSECONDS
        unstamped = column.stamp_ns == 0
        times[unstamped] = self.of_receptions(column.log_ns[unstamped])
        return times

    def of_receptions(self, log_ns: np.ndarray) -> np.ndarray:
        """By times of reception, ns."""
        received = (log_ns - self._received_0) / NANOSECONDS
        if not len(self._received):
            return received
        inside = np.interp(received, self._received, self._stamps)
        # Outside of the joint states both clocks are taken to run alike.
        return inside + received - np.clip(received, self._received[0], self._received[-1])
