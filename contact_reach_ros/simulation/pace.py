"""Real time for the simulated robot: when its ticks are due, and how many a late process has to make up for."""

from __future__ import annotations

_MAX_CATCH_UP_NS = 20_000_000


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
        ticks = max((now_ns - self.next_ns - _MAX_CATCH_UP_NS) // self._period_ns, 0)
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
