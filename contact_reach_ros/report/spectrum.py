"""Spectrum of the commanded torques: what vibrates in the gears."""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from contact_reach_ros.arm.arrays import Array

VIBRATION = 20.0
"""Frequency above which torques move gears and not the arm, Hz."""
_SEGMENT = 1024
_FEW = 64
"""With fewer samples there is no spectrum worth the name."""


def spectrum(time: Array, torque: Array) -> tuple[Array, Array]:
    """Power spectral density of torques (k, n), N m, at times (k,), s: frequencies (f,), Hz, and (f, n), N² m²/Hz.

    Both are empty for fewer than 64 samples.
    """
    known = np.isfinite(torque).all(axis=1)
    time, torque = time[known], torque[known]
    time, first = np.unique(time, return_index=True)
    torque = torque[first]
    if len(time) < _FEW:
        return np.zeros(0), np.zeros((0, torque.shape[1]))
    step = float(np.median(np.diff(time)))
    even = np.arange(time[0], time[-1], step)
    torque = np.stack([np.interp(even, time, joint) for joint in torque.T], axis=1)
    frequency, density = welch(torque, 1.0 / step, nperseg=min(_SEGMENT, len(even)), axis=0, detrend="linear")
    return frequency, density


def band_rms(frequency: Array, density: Array, low: float, high: float = np.inf) -> Array:
    """RMS of the torques between two frequencies, Hz: (n,), N m; NaN without a spectrum."""
    if not len(frequency):
        return np.full(density.shape[1], np.nan)
    inside = (frequency >= low) & (frequency < high)
    return np.asarray(np.sqrt(density[inside].sum(axis=0) * (frequency[1] - frequency[0])))
