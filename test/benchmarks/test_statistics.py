"""Intervals: of a bootstrap over targets, of shares, and of many claims together."""

import math

import numpy as np
import pytest

from benchmarks.statistics import corrected, estimate, share


def test_an_interval_covers_the_true_mean_about_as_often_as_it_says():
    random = np.random.default_rng(1)
    covered = [low <= 2.0 <= high for _, low, high in (estimate(random.exponential(2.0, 40)) for _ in range(200))]
    assert 0.88 <= np.mean(covered) <= 0.99


def test_equal_values_have_no_spread_and_one_value_no_interval():
    assert estimate([3.0, 3.0, 3.0]) == (3.0, 3.0, 3.0)
    assert estimate([3.0]).mean == 3.0
    assert math.isnan(estimate([3.0]).low)
    assert estimate([]).json == {"mean": None, "ci95": [None, None]}


def test_successes_without_a_failure_leave_room_for_one():
    mean, low, high = share(36, 36)
    assert (mean, high) == (1.0, 1.0)
    assert low == pytest.approx(0.025 ** (1 / 36))
    assert 0.9 < low < 0.91
    assert share(35, 35).low < 0.9
    assert share(0, 20).low == 0.0


def test_many_claims_need_wider_intervals():
    assert corrected(1) == pytest.approx(0.95)
    assert corrected(10) == pytest.approx(0.995)
    values = np.random.default_rng(0).normal(1.0, 1.0, 30)
    alone, together = estimate(values), estimate(values, corrected(10))
    assert together.low < alone.low < alone.mean < alone.high < together.high
