"""Summaries of episodes, differences between methods, and what is demanded of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import paper
from benchmarks.grid import Record
from benchmarks.statistics import CONFIDENCE, MIN_TARGETS, Estimate, corrected, estimate, share
from contact_reach_ros.arm import Array

GOAL_NAMES = {"hold": "orientation held", "free": "position only"}


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation (that of a sample) over `count` episodes; NaN where there are too few."""

    mean: float
    sd: float
    count: int


@dataclass(frozen=True)
class Demand:
    """A claim and the figures, one for each target, whose mean must be at least or at most `bound`.

    Attributes
    ----------
    text, unit
        In words.
    values
        One for each target.
    bound, is_least
        What the mean must be.
    is_share
        Whether the values are successes, 0 or 1.
    """

    text: str
    unit: str
    values: Array
    bound: float
    is_least: bool
    is_share: bool = False

    @property
    def required(self) -> str:
        """The bound in words; a difference has to be more than none."""
        sign = "≤" if not self.is_least else "≥" if self.bound else ">"
        return f"{sign} {self.bound:.3g} {self.unit}".rstrip()

    def is_met(self, interval: Estimate) -> bool:
        """Whether there are `MIN_TARGETS`, and the worse end of their interval meets the bound."""
        if len(self.values) < MIN_TARGETS:
            return False
        if not self.is_least:
            return bool(interval.high <= self.bound)
        return bool(interval.low >= self.bound if self.bound else interval.low > 0.0)

    def interval(self, confidence: float) -> Estimate:
        """The mean and its interval."""
        if self.is_share:
            return share(round(self.values.sum()), len(self.values), confidence)
        return estimate(self.values, confidence)


class Results:
    """The episodes of a run, by cell.

    Parameters
    ----------
    episodes
        Records of `run_cell`.
    """

    def __init__(self, episodes: Sequence[Record]) -> None:
        self.episodes = list(episodes)

    def of(self, scene: str, goal: str, method: str) -> list[Record]:
        """Episodes of all targets and repeats."""
        wanted = (scene, goal, method)
        return [entry for entry in self.episodes if (entry["scene"], entry["goal"], entry["method"]) == wanted]

    def summary(self, scene: str, goal: str, method: str, figure: str) -> Summary:
        """Mean and standard deviation of a figure over the episodes that have it."""
        values = [entry[figure] for entry in self.of(scene, goal, method) if entry[figure] is not None]
        mean = float(np.mean(values)) if values else math.nan
        sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
        return Summary(mean, sd, len(values))

    def by_target(self, scene: str, goal: str, method: str, figure: str) -> dict[int, float]:
        """Mean over the repeats of each target that have the figure."""
        values: dict[int, list[float]] = {}
        for entry in self.of(scene, goal, method):
            if entry[figure] is not None:
                values.setdefault(entry["target"], []).append(entry[figure])
        return {target: float(np.mean(found)) for target, found in values.items()}

    def difference(self, scene: str, goal: str, over: str, under: str, figure: str, factor: float = 1.0) -> Array:
        """A figure of the method `over`, less `factor` times that of `under`, for each target for which both have one.

        A difference, unlike a ratio, is defined where a force is zero: that `over` has at least `factor` times as much
        is a difference that is positive.
        """
        above, below = (self.by_target(scene, goal, method, figure) for method in (over, under))
        return np.array([above[target] - factor * below[target] for target in sorted(above.keys() & below.keys())])


def claims(results: Results, scenes: Sequence[str], goals: Sequence[str]) -> list[dict[str, Any]]:
    """What is demanded of the method, and whether it is met, as JSON has it.

    A claim is met only with `MIN_TARGETS` or more, and if the worse end of its interval meets it, where the intervals
    are so wide that all of them hold together with 95 %; `ci95` is the usual one, of this claim alone.
    """
    demands = [
        (goal, demand)
        for goal in goals
        for scene in scenes
        for demand in _demands(results, scene, goal)
        if len(demand.values)
    ]
    confidence = corrected(len(demands))
    found = []
    for goal, demand in demands:
        together = demand.interval(confidence)
        found.append(
            {
                "claim": demand.text,
                "goal": goal,
                "required": demand.required,
                "value": together.mean,
                "ci95": demand.interval(CONFIDENCE).json["ci95"],
                "ci_corrected": together.json["ci95"],
                "targets": len(demand.values),
                "met": demand.is_met(together),
            }
        )
    return found


def _demands(results: Results, scene: str, goal: str) -> Iterator[Demand]:
    """What is demanded in one scene; those that nothing was measured for have no values."""

    def figure(name: str) -> Array:
        return np.array(list(results.by_target(scene, goal, paper.METHOD, name).values()))

    successes = np.floor(figure("success"))
    yield Demand(f"{scene}: settles at the goal within ε", "", successes, paper.SUCCESS, True, is_share=True)
    if scene in paper.TIME_RATIO_LIMITS:
        limit = paper.TIME_RATIO_LIMITS[scene]
        yield Demand(f"{scene}: time to settle over the kinematic limit", "", figure("time_ratio"), limit, False)
    if scene in paper.FORCE_RATIOS:
        factor = paper.FORCE_RATIOS[scene]
        peaks = results.difference(scene, goal, paper.REFERENCE_POSTURE, paper.METHOD, "max_contact_force", factor)
        yield Demand(
            f"{scene}: peak force of reference posture, less {factor:g} times the method's", "N", peaks, 0.0, True
        )
        published = paper.TABLE_1[scene, paper.METHOD].force
        text = f"{scene}: peak force of the paper (on another scale)"
        yield Demand(text, "N", figure("max_contact_force"), published, False)
    if scene in paper.COLLISION_FREE_TIME_RATIO:
        factor = paper.COLLISION_FREE_TIME_RATIO[scene]
        for method in (paper.COLLISION_FREE, paper.RRT_STAR):
            times = results.difference(scene, goal, method, paper.METHOD, "time", factor)
            yield Demand(f"{scene}: time of {method}, less {factor:g} times the method's", "s", times, 0.0, True)
    if scene in paper.TORQUE_SCENES:
        torques = results.difference(scene, goal, paper.REFERENCE_POSTURE, paper.METHOD, "max_external_torque")
        yield Demand(f"{scene}: external torque of reference posture, less the method's", "Nm", torques, 0.0, True)


def plus_minus(summary: Summary, digits: int = 2) -> str:
    """Mean ± standard deviation, as far as there are any."""
    if not summary.count:
        return "–"
    mean = f"{summary.mean:.{digits}f}"
    return mean if math.isnan(summary.sd) else f"{mean} ± {summary.sd:.{digits}f}"


def interval_text(value: float, ends: Sequence[float | None] | None) -> str:
    """A value and the ends of its interval."""
    if not ends or ends[0] is None or ends[1] is None:
        return f"{value:.2f}"
    return f"{value:.2f} [{ends[0]:.2f}, {ends[1]:.2f}]"
