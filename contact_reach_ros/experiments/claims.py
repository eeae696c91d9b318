"""Summaries of episodes, ratios between methods, and what is demanded of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.grid import Record

RESAMPLES = 10000
"""Of the bootstrap; its seed is fixed, so that the same episodes give the same interval."""

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation (that of a sample) over `count` episodes; NaN where there are too few."""

    mean: float
    sd: float
    count: int


@dataclass(frozen=True)
class Ratio:
    """How many times as large a figure is with one method as with another.

    Attributes
    ----------
    of_means
        Mean over all episodes of the one, over that of the other.
    low, high
        Bounds of its confidence interval, from a bootstrap over targets; NaN with fewer than two.
    paired_median
        Median over targets of the ratio within a target.
    targets
        Targets that both have a figure for.
    """

    of_means: float
    low: float
    high: float
    paired_median: float
    targets: int


@dataclass(frozen=True)
class Claim:
    """One demand and what was measured; `met` is None if there was nothing to measure."""

    text: str
    goal: str
    required: str
    measured: str
    met: bool | None


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

    def ratio(self, scene: str, goal: str, over: str, under: str, figure: str) -> Ratio | None:
        """A figure of the method `over` divided by that of `under`, on the targets for which both have one.

        None if there is no such target, or if both are zero on all of them.
        """
        numerators = self._by_target(scene, goal, over, figure)
        denominators = self._by_target(scene, goal, under, figure)
        common = sorted(numerators.keys() & denominators.keys())
        above = np.array([numerators[target] for target in common])
        below = np.array([denominators[target] for target in common])
        if not common or (above.sum() == 0.0 and below.sum() == 0.0):
            return None
        low, high = _interval(above, below)
        pairs = _quotients(above, below)
        pairs = pairs[~np.isnan(pairs)]
        return Ratio(float(_quotients(above.sum(), below.sum())), low, high, _median(pairs), len(common))

    def _by_target(self, scene: str, goal: str, method: str, figure: str) -> dict[int, float]:
        """Mean over the repeats of each target that have the figure."""
        values: dict[int, list[float]] = {}
        for entry in self.of(scene, goal, method):
            if entry[figure] is not None:
                values.setdefault(entry["target"], []).append(entry[figure])
        return {target: float(np.mean(found)) for target, found in values.items()}


def claims(results: Results, scenes: Sequence[str], goals: Sequence[str]) -> list[Claim]:
    """What is demanded of the method, for each kind of goal."""
    made = []
    for goal in goals:
        for scene in scenes:
            made.append(_success(results, scene, goal))
        for scene, limit in paper.TIME_RATIO_LIMITS.items():
            text = f"{scene}: time over the kinematic limit"
            made.append(_at_most(results, scene, goal, "time_ratio", limit, text, ""))
        for scene in paper.TIME_RATIO_LIMITS:
            published = paper.TABLE_1[scene, paper.METHOD].time
            limit = paper.PAPER_TIME_SHARE * published
            text = f"{scene}: time below half of the paper's {published:g} s"
            made.append(_at_most(results, scene, goal, "time", limit, text, " s"))
        for scene, least in paper.FORCE_RATIOS.items():
            text = f"{scene}: maximum force, reference posture over the method"
            made.append(
                _ratio_at_least(results, scene, goal, paper.REFERENCE_POSTURE, "max_contact_force", least, text)
            )
        for scene, least in paper.COLLISION_FREE_TIME_RATIO.items():
            text = f"{scene}: time, collision-free over the method"
            made.append(_ratio_at_least(results, scene, goal, paper.COLLISION_FREE, "time", least, text))
        for scene in paper.FORCE_RATIOS:
            limit = paper.TABLE_1[scene, paper.METHOD].force
            text = f"{scene}: maximum force of the paper (its foam is not published)"
            made.append(_at_most(results, scene, goal, "max_contact_force", limit, text, " N"))
    return [claim for claim in made if claim.text.partition(":")[0] in scenes]


def _success(results: Results, scene: str, goal: str) -> Claim:
    episodes = results.of(scene, goal, paper.METHOD)
    reached, stops = sum(entry["reached"] for entry in episodes), sum(bool(entry["stop_reason"]) for entry in episodes)
    met = reached == len(episodes) and stops == 0 if episodes else None
    measured = f"{reached} of {len(episodes)} reached, {stops} stopped" if episodes else ""
    return Claim(f"{scene}: every goal reached, no latched stop", goal, "100 %, 0 stopped", measured, met)


def _at_most(results: Results, scene: str, goal: str, figure: str, limit: float, text: str, unit: str) -> Claim:
    found = results.summary(scene, goal, paper.METHOD, figure)
    required = f"≤ {limit:.3g}{unit}"
    if not found.count:
        return Claim(text, goal, required, "", None)
    return Claim(text, goal, required, f"{plus_minus(found)}{unit}", found.mean <= limit)


def _ratio_at_least(results: Results, scene: str, goal: str, over: str, figure: str, least: float, text: str) -> Claim:
    ratio = results.ratio(scene, goal, over, paper.METHOD, figure)
    if ratio is None:
        return Claim(text, goal, f"≥ {least:g}", "", None)
    return Claim(text, goal, f"≥ {least:g}", ratio_text(ratio), ratio.of_means >= least)


def ratio_text(ratio: Ratio) -> str:
    """In words: of means, confidence interval, median of pairs."""
    words = [number(ratio.of_means)]
    if not math.isnan(ratio.low):
        words[0] += f" [{number(ratio.low)}, {number(ratio.high)}]"
    words.append(f"paired median {number(ratio.paired_median)}")
    words.append(f"{ratio.targets} target{'s' if ratio.targets != 1 else ''}")
    return ", ".join(words)


def plus_minus(summary: Summary, digits: int = 2) -> str:
    """Mean ± standard deviation, as far as there are any."""
    if not summary.count:
        return "–"
    mean = f"{summary.mean:.{digits}f}"
    return mean if math.isnan(summary.sd) else f"{mean} ± {summary.sd:.{digits}f}"


def number(value: float) -> str:
    """A ratio for the reader."""
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{value:.2f}" if value < 100.0 else f"{value:.0f}"


def _interval(above: Array, below: Array) -> tuple[float, float]:
    """Of the ratio of means, by resampling targets: those, not the repeats, are independent of each other."""
    if len(above) < 2:
        return math.nan, math.nan
    chosen = np.random.default_rng(0).integers(len(above), size=(RESAMPLES, len(above)))
    ratios = _quotients(above[chosen].sum(axis=1), below[chosen].sum(axis=1))
    ratios = np.sort(ratios[~np.isnan(ratios)])
    tail = 0.5 * (1.0 - CONFIDENCE)
    # Without interpolation, which infinite ratios would not survive.
    low, high = (ratios[round(share * (len(ratios) - 1))] for share in (tail, 1.0 - tail))
    return float(low), float(high)


def _quotients(above: Array, below: Array) -> Array:
    """Infinity for something over nothing, NaN for nothing over nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(above, below)


def _median(values: Array) -> float:
    """The lower one of two in the middle, which may be infinite."""
    return float(np.sort(values)[(len(values) - 1) // 2]) if len(values) else math.nan
