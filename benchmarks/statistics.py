"""Means with intervals from a bootstrap over targets: those, not the repeats of each, are independent of each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import beta

from contact_reach_ros.arm import Array

CONFIDENCE = 0.95
MIN_TARGETS = 10
"""Fewer than these show nothing: resampling them seldom draws anything but what they happen to be."""
RESAMPLES = 10000
"""Of the bootstrap; its seed is fixed, so that the same episodes give the same interval."""


class Estimate(NamedTuple):
    """A mean over targets and its interval; NaN where there are too few."""

    mean: float
    low: float
    high: float

    @property
    def json(self) -> dict[str, float | list[float | None] | None]:
        """`mean` and `ci95`, as reports have them; None for NaN."""
        mean, *interval = (None if math.isnan(value) else value for value in self)
        return {"mean": mean, "ci95": interval}


def estimate(values: Sequence[float] | Array, confidence: float = CONFIDENCE) -> Estimate:
    """The mean of one value for each target, with the percentile interval of a bootstrap."""
    array = np.asarray(values, float)
    if not len(array):
        return Estimate(math.nan, math.nan, math.nan)
    if len(array) < 2:
        return Estimate(float(array.mean()), math.nan, math.nan)
    chosen = np.random.default_rng(0).integers(len(array), size=(RESAMPLES, len(array)))
    tail = 0.5 * (1.0 - confidence)
    low, high = np.quantile(array[chosen].mean(axis=1), (tail, 1.0 - tail))
    return Estimate(float(array.mean()), float(low), float(high))


def share(successes: int, count: int, confidence: float = CONFIDENCE) -> Estimate:
    """A share and its exact interval (Clopper and Pearson), which a bootstrap of equal outcomes would make a point."""
    if not count:
        return Estimate(math.nan, math.nan, math.nan)
    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, successes, count - successes + 1)) if successes else 0.0
    high = float(beta.ppf(1.0 - tail, successes + 1, count - successes)) if successes < count else 1.0
    return Estimate(successes / count, low, high)


def corrected(claims: int) -> float:
    """Confidence of each of so many intervals of which all hold together with `CONFIDENCE` (Bonferroni)."""
    return 1.0 - (1.0 - CONFIDENCE) / max(claims, 1)
