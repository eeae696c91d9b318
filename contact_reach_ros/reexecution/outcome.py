"""What a re-execution of controller or observer came to."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.timing import NANOSECONDS


class Difference(NamedTuple):
    """Where a re-execution first differs from the recording."""

    tick: int
    """Number of the output, counted from 1 at the start of the node."""
    stamp_ns: int
    field: str
    recorded: float | str
    reexecuted: float | str

    def text(self, origin_ns: int) -> str:
        """In words, with the time since `origin_ns`."""
        since = (self.stamp_ns - origin_ns) / NANOSECONDS
        return f"tick {self.tick}, {since:.3f} s, {self.field}: recorded {self.recorded}, re-executed {self.reexecuted}"


@dataclasses.dataclass(frozen=True)
class Reexecution:
    """One node, re-executed.

    Attributes
    ----------
    node :
        Its name.
    stamp_ns :
        (k,) of the joint states that it answered.
    values :
        (k, n) re-executed torques or residuals, N m.
    recorded :
        (k, n) the recorded ones; NaN where the bag lacks them.
    compared :
        How many were compared: those that are in the bag, from where the node's state is known.
    largest_difference :
        N m; NaN if nothing was compared.
    first_difference :
        None if there is none.
    reasons :
        Why the re-executed node stopped the arm.
    notes :
        What could not be done, one sentence each.
    seconds :
        Processor time that it took.
    """

    node: str
    stamp_ns: NDArray[np.int64]
    values: Array
    recorded: Array
    compared: int
    largest_difference: float
    first_difference: Difference | None
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    seconds: float

    @property
    def duration(self) -> float:
        """Time of the robot's clock that was re-executed, s."""
        return float(self.stamp_ns[-1] - self.stamp_ns[0]) / NANOSECONDS if len(self.stamp_ns) else 0.0


def realtime_factor(found: Mapping[str, Reexecution]) -> float:
    """How many times faster than the robot controller and observer together were re-executed."""
    seconds = sum(one.seconds for one in found.values())
    return max((one.duration for one in found.values()), default=0.0) / seconds if seconds else float("nan")
