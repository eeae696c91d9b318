"""What a re-execution of the planner came to."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.planning.plan import Plan

ROUNDING = 1e-7
"""Largest difference of a number, of its magnitude above 1, that another processor's rounding accounts for.

It holds for each plan solved on the way: what one is off by goes into the next.
"""


class PlanDifference(NamedTuple):
    """Where a plan differs from the recorded one."""

    plan: int
    field: str
    recorded: float
    reexecuted: float

    def __str__(self) -> str:
        return f"plan {self.plan}, {self.field}: recorded {self.recorded}, re-executed {self.reexecuted}"


@dataclasses.dataclass(frozen=True)
class ReexecutedPlan:
    """A plan solved again.

    Attributes
    ----------
    number :
        Of the plan.
    plan :
        The re-executed plan.
    statistics :
        The recorded ones, by the keys of plan/statistics.
    solved :
        How many plans were solved on the way, this one included.
    first_difference :
        Beyond `ROUNDING`, of all of these; None if there is none. With changed settings nothing is compared.
    rounding :
        Largest difference within `ROUNDING` up to there; 0 if everything is identical, bit for bit.
    seconds :
        Wall-clock time.
    """

    number: int
    plan: Plan
    statistics: Mapping[str, str]
    solved: int
    first_difference: PlanDifference | None
    rounding: float
    seconds: float


def compare_plans(
    number: int, recorded: Mapping[str, Array], now: Mapping[str, Array], rounding: float
) -> tuple[PlanDifference | None, float]:
    """Compare a plan with the recorded one.

    Parameters
    ----------
    number
        Of the plan.
    recorded, now
        Arrays (n,) by field; fields that are only recorded are not compared.
    rounding
        Greatest difference that does not count, of a number's magnitude above 1.

    Returns
    -------
    The first difference beyond rounding, None if there is none, and the largest one within it before that.
    """
    largest = 0.0
    for field, values in now.items():
        before = recorded.get(field, np.zeros(0))
        if before.shape != values.shape:
            return PlanDifference(number, f"number of {field}", before.size, values.size), largest
        off = np.where(values == before, 0.0, np.abs(values - before) / np.maximum(1.0, np.abs(before)))
        beyond = np.flatnonzero(~(off <= rounding))
        if beyond.size:
            index = int(beyond[0])
            where = field if values.size == 1 else f"{field}[{index}]"
            return PlanDifference(number, where, float(before[index]), float(values[index])), largest
        largest = max(largest, float(off.max(initial=0.0)))
    return None, largest
