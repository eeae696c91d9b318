"""Percentiles from buckets, and the order of stamps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.timing import (
    Histogram,
    StampOrder,
    counts_between,
    percentiles_us,
    read_counts,
    write_counts,
)

SHARE = 1 / 64
"""Of a duration: width of its bucket, if that is not 1 µs."""


def filled(durations_us: list[float]) -> Histogram:
    histogram = Histogram()
    for duration in durations_us:
        histogram.add(round(1000 * duration))
    return histogram


@given(st.lists(st.integers(0, 99_999), min_size=1, max_size=200), st.floats(0.1, 100))
def test_percentiles_are_exact_to_a_bucket(durations_us, percent):
    true = np.percentile(durations_us, percent, method="inverted_cdf")
    assert true <= filled(durations_us).percentile_us(percent) <= true + max(1.0, SHARE * true)


def test_longest_duration_is_kept_exactly():
    histogram = filled([10.0] * 99 + [250_000.25])
    assert histogram.maximum_ns == 250_000_250
    assert histogram.percentile_us(50) == 11.0
    assert histogram.percentile_us(100) == 250_000.25


def test_negative_durations_count_as_zero():
    histogram = filled([-1.0, -1e9])
    histogram.add(20_000)
    assert histogram.count == 3
    assert histogram.percentile_us(50) == 1.0
    assert histogram.maximum_ns == 20_000


def test_counts_hold_how_many_durations_there_were_of_each_length():
    histogram = filled([1.0, 1.5, 7.0, 999.0, 1234.0, 150_000.0])
    counts = histogram.counts()
    assert list(counts.values()) == [2, 1, 1, 1, 1]
    for edge, duration in zip(counts, [1.5, 7.0, 999.0, 1234.0, 150_000.0], strict=True):
        assert duration < edge <= duration + max(1.0, SHARE * duration)
    assert read_counts(write_counts(counts)) == counts


@given(st.lists(st.integers(0, 99_999), max_size=50), st.lists(st.integers(0, 99_999), max_size=50))
def test_what_happened_between_two_times_has_counts_of_its_own(before, between):
    histogram = filled(before)
    first = histogram.counts()
    for duration in between:
        histogram.add(1000 * duration)
    assert counts_between(first, histogram.counts()) == dict(sorted(filled(between).counts().items()))


def test_percentiles_of_counts_are_those_of_the_histogram():
    histogram = filled(list(np.linspace(1, 990, 2000)))
    assert percentiles_us(histogram.counts()) == pytest.approx(histogram.summary(), rel=SHARE, abs=1.0)
    assert all(math.isnan(value) for value in percentiles_us({}).values())


class TestStampOrder:
    def test_old_messages_that_come_again_are_not_new(self):
        order = StampOrder()
        accepted = []
        for newest in range(100, 200):
            for stamp in (newest, newest - 20, newest):
                if order.is_new(stamp):
                    accepted.append(stamp)
        assert accepted == list(range(100, 200))
        assert (order.repeated, order.older) == (100, 100)

    def test_a_clock_that_was_set_back_is_followed_after_a_few_messages(self):
        order = StampOrder()
        order.is_new(1000)
        assert [order.is_new(stamp) for stamp in range(10, 20)] == [False] * 5 + [True] * 5

    def test_one_old_message_again_and_again_is_no_clock(self):
        order = StampOrder()
        order.is_new(1000)
        assert not any(order.is_new(stamp) for stamp in [990] * 100 + [1000] * 100)
        assert order.is_new(1001)
