"""Estimate of how long before its effect a plan must be begun."""

from __future__ import annotations

from collections import deque

from contact_reach_ros.units import NANOSECONDS

_RECENT = 8
_MAX_NS = NANOSECONDS // 4


class LatencyEstimate:
    """Time until a plan begun now can take effect: as long as the last ones took, which varies on a busy machine.

    Parameters
    ----------
    least_ns
        Shortest estimate, ns.
    fixed
        Whether the shortest estimate always holds, as in lockstep, where no plan is late.
    """

    def __init__(self, least_ns: int, fixed: bool = False) -> None:
        self._least_ns = least_ns
        self._recent_ns: deque[int] = deque(maxlen=0 if fixed else _RECENT)

    def add(self, took_ns: int) -> None:
        """Take the time from a plan's request to its publication, ns."""
        self._recent_ns.append(took_ns)

    def __call__(self) -> int:
        """The estimate, ns."""
        return max(self._least_ns, min(max(self._recent_ns, default=0), _MAX_NS))
