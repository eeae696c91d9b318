"""Spectrum of torques: known vibrations are found where they are, whatever the samples are like."""

import numpy as np
import pytest

from contact_reach_ros.report.spectrum import VIBRATION, band_rms, spectrum


@pytest.mark.parametrize("period", [0.001, 0.005])
def test_each_vibration_is_found_in_its_band(period: float) -> None:
    time = np.arange(0.0, 4.0, period)
    slow, fast = 10.0 * np.sin(2 * np.pi * 3.0 * time), 0.5 * np.sin(2 * np.pi * 33.0 * time)
    frequency, density = spectrum(time, np.stack([slow + fast, slow], axis=1))
    assert frequency[-1] == pytest.approx(0.5 / period)
    found = band_rms(frequency, density, VIBRATION)
    assert found[0] == pytest.approx(0.5 / np.sqrt(2.0), rel=0.05) and found[1] < 0.05
    assert band_rms(frequency, density, 40.0)[0] < 0.05


def test_missing_and_repeated_samples_are_bridged() -> None:
    time = np.arange(0.0, 4.0, 0.001)
    torque = np.sin(2 * np.pi * 33.0 * time)[:, None]
    kept = np.sort(np.concatenate([np.delete(np.arange(len(time)), [500, 1200, 1201]), [700, 700]]))
    torque[900] = np.nan
    frequency, density = spectrum(time[kept], torque[kept])
    assert band_rms(frequency, density, VIBRATION)[0] == pytest.approx(1.0 / np.sqrt(2.0), rel=0.05)
