"""From joint states to smooth samples."""

import numpy as np
import pytest
from motions import ARM, MOMENTUM, motion, recording, torques

from contact_reach_ros.arm import JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.identification.recording import make_recording, make_samples, recording_of
from contact_reach_ros.observer.settings import MomentumSettings

RECORDING = recording(ARM, 12.0, 0.001, noise=0.0)


def test_samples_have_no_lag():
    samples = make_samples(RECORDING, MOMENTUM)
    times, q, v, a = motion(12.0, 0.001)
    at = np.searchsorted(times, 0.25) + 20 * np.arange(len(samples.q))
    np.testing.assert_allclose(samples.q, q[at], atol=1e-4)
    np.testing.assert_allclose(samples.v, v[at], atol=1e-3)
    np.testing.assert_allclose(samples.a, a[at], atol=0.02)


def test_a_gap_and_unknown_torques_split_the_recording():
    torque = RECORDING.torque.copy()
    torque[7000:7100] = np.nan
    keep = np.r_[0:3000, 3500 : len(torque)]
    samples = make_samples(make_recording(*(each[keep] for each in RECORDING._replace(torque=torque))), MOMENTUM)
    assert np.unique(samples.piece).tolist() == [0, 1, 2]
    expected = torques(ARM, samples.q, samples.v, samples.a)
    moves = samples.moves
    # Nowhere a trace of the edges; friction that changes its sign is smoothed in both.
    assert np.abs(samples.torque - expected)[moves].max() < 0.4


def test_torques_of_a_slow_drive_are_compared_with_a_motion_as_late():
    cutoff, keep = 10.0, np.exp(-2.0 * np.pi * 10.0 * 0.001)
    slow = np.empty_like(RECORDING.torque)
    slow[0] = RECORDING.torque[0]
    for index in range(1, len(slow)):
        slow[index] = keep * slow[index - 1] + (1.0 - keep) * RECORDING.torque[index]
    samples = make_samples(RECORDING._replace(torque=slow), MomentumSettings(torque_cutoff=cutoff).resolve(ARM))
    error = np.abs(samples.torque - torques(ARM, samples.q, samples.v, samples.a))[samples.moves].max()
    without = make_samples(RECORDING._replace(torque=slow), MOMENTUM)
    lagging = np.abs(without.torque - torques(ARM, without.q, without.v, without.a))[without.moves].max()
    assert error < 0.5 < lagging


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([], "has no joint states; expected 10 s"),
        ([JointState(0, np.zeros(7), np.zeros(7), np.zeros(7))], "has no joint states"),
        ([JointState(k, np.zeros(7), np.zeros(7), None) for k in range(9)], "carry no effort"),
        (
            list(map(JointState, *recording(ARM, 5.0))),
            "holds 5.0 s of states without gaps and with",
        ),
    ],
)
def test_what_cannot_be_used_is_named(states, message):
    with pytest.raises(InputError, match=message):
        recording_of(states)
