"""Recorded joint states, and the smooth samples that a model is fitted to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError
from contact_reach_ros.observer.settings import COULOMB_SPEED, MomentumSettings
from contact_reach_ros.timing import GAP_PERIODS, NANOSECONDS

LEAST_S = 10.0
"""Shortest recording that is fitted, without its pauses, s."""
MOVING = 0.05
"""Speed from which the friction of a joint is that of motion, rad/s."""

_CUTOFF = 10.0
"""Of the low-pass that everything passes, Hz: above the motion of the arm, below most of the noise."""
_EDGE_S = 0.25
"""What is left out at both ends of a piece, where the low-pass has nothing to go on from, s."""
_SAMPLE_S = 0.02
"""Between samples, s: closer ones would tell the same."""


class Recording(NamedTuple):
    """The states of a motion.

    Attributes
    ----------
    stamps_ns
        (N,), increasing, ns.
    q, v, torque
        (N, n): positions rad, velocities rad/s, measured torques N m; NaN where they are unknown.
    """

    stamps_ns: np.ndarray
    q: Array
    v: Array
    torque: Array

    @property
    def period(self) -> float:
        """Median time between states, s."""
        return float(np.median(np.diff(self.stamps_ns))) / NANOSECONDS


def make_recording(stamps_ns: np.ndarray, q: Array, v: Array, torque: Array, name: str = "recording") -> Recording:
    """Put states, as in `Recording` but in any order, together; repeated ones are left out.

    Raises `InputError` if there are too few, or none has torques; `name` is that of the recording in the message.
    """
    order = np.unique(stamps_ns, return_index=True)[1]
    recording = Recording(stamps_ns[order], q[order], v[order], torque[order])
    if len(order) < 2:
        raise InputError(f"{name}: has no joint states; expected {LEAST_S:g} s of motion")
    if np.isnan(recording.torque).all():
        raise InputError(f"{name}: joint_states carry no effort; expected measured torques, or commanded ones")
    known = sum(len(piece.stamps_ns) for piece in _pieces(recording)) * recording.period
    if known < LEAST_S:
        raise InputError(
            f"{name}: holds {known:.1f} s of states without gaps and with torques; expected at least {LEAST_S:g} s"
        )
    return recording


def recording_of(states: Sequence[JointState]) -> Recording:
    """The same from states, whose torques are unknown where they have none; raises as `make_recording`."""
    torques = [np.full_like(state.q, np.nan) if state.torque is None else state.torque for state in states]
    stamps = np.array([state.stamp_ns for state in states], np.int64)
    q, v = np.array([state.q for state in states]), np.array([state.v for state in states])
    return make_recording(stamps, q, v, np.array(torques))


class Samples(NamedTuple):
    """Smooth samples of a motion, (N, n) each.

    Attributes
    ----------
    q, v, a
        Positions rad, velocities rad/s, accelerations rad/s².
    torque
        Torques, N m.
    direction
        Share of the dry friction that acts, -1 to 1.
    moves
        Whether the joint moves fast enough for the friction of motion.
    piece
        (N,) number of the uninterrupted piece of the recording.
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    direction: Array
    moves: np.ndarray
    piece: np.ndarray


def make_samples(recording: Recording, momentum: MomentumSettings) -> Samples:
    """Filter a recording without a phase, piece by piece, and differentiate its velocities.

    Torques that have passed the drive's low-pass are compared with a motion that has passed the same.
    """
    period = recording.period
    sos = butter(4, min(_CUTOFF, 0.2 / period), fs=1.0 / period, output="sos")
    edge, every = round(_EDGE_S / period), max(1, round(_SAMPLE_S / period))
    keep = np.exp(-2.0 * np.pi * momentum.torque_cutoff * period) if momentum.torque_cutoff else 0.0

    def late(values: Array) -> Array:
        start = (keep * values[0])[None]
        return lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=start)[0] if keep else values

    found = []
    for number, piece in enumerate(_pieces(recording)):
        if len(piece.stamps_ns) <= 2 * edge + every:
            continue
        q, v = (sosfiltfilt(sos, late(_evenly(piece, values)), axis=0) for values in (piece.q, piece.v))
        torque = sosfiltfilt(sos, _evenly(piece, piece.torque), axis=0)
        direction = sosfiltfilt(sos, np.tanh(v / COULOMB_SPEED), axis=0)
        a = np.gradient(v, period, axis=0)
        part = slice(edge, -edge, every)
        parts = (q[part], v[part], a[part], torque[part], direction[part])
        found.append((*parts, np.abs(parts[1]) > MOVING, np.full(len(parts[0]), number)))
    return Samples(*map(np.concatenate, zip(*found, strict=True)))


def _evenly(piece: Recording, values: Array) -> Array:
    """Values (N, n) at equal steps, although some states are missing."""
    at = (piece.stamps_ns - piece.stamps_ns[0]) / NANOSECONDS
    even = np.arange(0.0, at[-1], piece.period)
    return np.stack([np.interp(even, at, column) for column in values.T], axis=1)


def _pieces(recording: Recording) -> Iterator[Recording]:
    """The parts between gaps and unknown torques, each longer than what is left out of it."""
    known: np.ndarray = np.all(np.isfinite(np.hstack([recording.q, recording.v, recording.torque])), axis=1)
    steps = np.diff(recording.stamps_ns) > GAP_PERIODS * recording.period * NANOSECONDS
    breaks = np.flatnonzero(steps | (known[1:] != known[:-1])) + 1
    least = 2.0 * _EDGE_S / recording.period
    for part in np.split(np.arange(len(known)), breaks):
        if known[part[0]] and len(part) > least:
            yield Recording(*(values[part] for values in recording))
