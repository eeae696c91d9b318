"""Stops of an arm whose model does not fit it."""

import pytest

from benchmarks.stops import BRAKED, SPEED, TRAVEL, stop_at_rest


@pytest.mark.slow
def test_a_stopped_arm_with_a_payload_that_nobody_knows_does_not_sink():
    record = stop_at_rest(("ball_mismatch", 0))
    assert record["stopped early"] == "" and record["reason"] == "stop requested"
    assert 0.0 < record["speed"] <= SPEED and 0.0 < record["travel"] <= TRAVEL
    # The drive's brakes have taken over.
    assert record["mode"] == "silent" and record["braked"] <= BRAKED
