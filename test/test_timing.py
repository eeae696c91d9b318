"""Percentiles from buckets, and the order of stamps."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.timing import (
    PERCENTILES,
    Histogram,
    StampOrder,
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


@given(st.lists(st.integers(0, 99_999), min_size=1, max_size=200))
def test_percentiles_are_exact_to_a_bucket(durations_us):
    histogram = filled(durations_us)
    for found in (histogram.summary(), percentiles_us(read_counts(write_counts(histogram.counts)))):
        for name, percent in PERCENTILES.items():
            true = np.percentile(durations_us, percent, method="inverted_cdf")
            assert true <= found[name] <= true + max(1.0, SHARE * true)


def test_the_longest_duration_is_exact_and_none_is_negative():
    histogram = filled([-1.0, -1e9, 250_000.25])
    assert histogram.maximum_ns == 250_000_250
    assert histogram.summary()["p50"] == 1.0 and histogram.summary()["p999"] == 250_000.25
    assert histogram.counts[1] == 2
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


class Growing(dict[int, int]):
    """Counts to which another thread adds whenever they were looked at."""

    def __iter__(self):
        return iter([edge for edge, _ in self.items()])

    def items(self):
        found = list(super().items())
        self[len(found) + 1] = 1000
        return found


def test_counts_may_grow_while_they_are_summarised():
    assert percentiles_us(Growing({1: 1})) == dict.fromkeys(PERCENTILES, 1.0)
