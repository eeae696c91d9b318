"""Percentiles of durations, and the order of stamps."""

import math

import numpy as np
import pytest

from contact_reach_ros.timing import Durations, StampOrder


def test_percentiles_are_of_the_newest_minute_in_microseconds():
    durations = Durations()
    assert all(math.isnan(value) for value in durations.summary().values())
    durations.add(-5)
    assert durations.summary()["p999"] == 0.0
    newest = np.random.default_rng(1).integers(100_000, 400_000, 60_000)
    for duration_ns in [*[900_000] * 1000, *newest.tolist()]:
        durations.add(duration_ns)
    expected = np.percentile(newest, [50.0, 95.0, 99.0, 99.9, 100.0], method="nearest") / 1000.0
    assert durations.summary() == pytest.approx(dict(zip(["p50", "p95", "p99", "p999", "max"], expected, strict=True)))


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
