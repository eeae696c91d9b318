"""The bench of smoothness: what it computes of a motion, and what the ramp of the references is good for."""

import numpy as np
import pytest

from benchmarks.smoothness import Case, jerk_rms, run_smoothness


def test_jerk_of_a_swing() -> None:
    time = np.arange(0.0, 5.0, 0.001)
    turn = 2 * np.pi * 2.0
    position = 0.01 * np.stack([np.sin(turn * time), np.cos(turn * time), 0.0 * time], axis=1)
    assert jerk_rms(position) == pytest.approx(0.01 * turn**3, rel=0.01)


@pytest.mark.slow
def test_references_that_move_do_not_shake_the_gears() -> None:
    stepping, moving = (run_smoothness(Case("free", 0, ramp)) for ramp in (0.0, 0.03))
    worst = [max(report["torque_rms_Nm"]["20-500 Hz"]) for report in (stepping, moving)]
    assert worst[0] > 1.5 and worst[1] < 0.5
    assert stepping["reached"] and moving["reached"]
    assert moving["duration_s"] < 1.03 * stepping["duration_s"]
    assert moving["jerk_rms_m_s3"] < stepping["jerk_rms_m_s3"]
