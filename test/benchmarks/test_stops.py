"""Stops of an arm whose model does not fit it."""

import numpy as np
from arm_simulation import ARM

from benchmarks.stops import SPEED, TRAVEL, random_posture, stop_at_rest
from contact_reach_ros.world.collision import nearest


def test_postures_are_within_the_limits_and_free_of_the_arm_itself():
    postures = np.array([random_posture(ARM, seed) for seed in range(20)])
    assert (postures > ARM.lower).all() and (postures < ARM.upper).all()
    assert np.ptp(postures, axis=0).min() > 1.0
    assert min(found.distance for found in nearest(ARM, postures, ())) > 0.0


def test_a_stopped_arm_with_a_payload_that_nobody_knows_does_not_sink():
    record = stop_at_rest(("ball_mismatch", 0))
    assert record["stopped early"] == "" and record["reason"] == "stop requested"
    assert 0.0 < record["speed"] <= SPEED and 0.0 < record["travel"] <= TRAVEL
    # The drive's brakes have taken over.
    assert record["mode"] == "silent"
