"""The observer bench reports what it measured."""

import json

import numpy as np
import pytest
from bench_command import bench

from benchmarks import observer, observer_trials
from contact_reach_ros.arms import load_arm
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.world.scene import MismatchSettings


def test_report_holds_what_it_should(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(observer, "PUSHES", 3)
    file = tmp_path / "observer.json"
    assert bench(observer, "--minutes", "0.02", "--json", file) == 0
    report = json.loads(file.read_text())
    assert abs(report["step_63_error"]) < 0.05
    assert 0.0 < report["free_rms_nm"]["max"] < 10.0
    latency = report["detection_latency_ms"]
    assert 1.0 <= latency["p50"] <= latency["p95"] <= 100.0
    assert report["missed_contacts"] <= 1 and report["false_stops_per_hour"] == 0.0
    # The higher the thresholds, the less is seen, rightly or falsely.
    assert np.all(np.diff(report["roc"]["seen_share"]) <= 0.0)
    assert "3 pushes of 50 N at mid-arm" in capsys.readouterr().out


def test_minutes_out_of_range_are_refused(capsys):
    assert bench(observer, "--minutes", "0") == 2
    assert "minutes = 0: expected a number above 0" in capsys.readouterr().err


def test_stop_in_free_motion_is_counted_and_named(monkeypatch):
    # With thresholds below the noise the arm is stopped as soon as it is watched.
    monkeypatch.setattr(observer_trials, "_EPISODE_S", 2.0)
    budget = ContactBudget(torque_thresholds=(0.5,) * 7, torque_per_speed=(0.0,) * 7)
    run = observer_trials.move_freely(load_arm(), MismatchSettings(), 0.02, budget)
    assert len(run.stops) >= 1
    assert "seed 0, 0.5" in run.stops[0]
    assert "external torque on lbr_A2" in run.stops[0]


def test_onsets_are_debounced_and_merged():
    ratios = [0.0] * 10 + [3.0] + [0.0] * 10 + [3.0] * 5 + [0.0] * 10 + [3.0] * 5 + [0.0] * 100 + [3.0] * 5
    counts = dict(zip(observer_trials.SCALES, observer_trials.count_onsets(ratios), strict=True))
    assert all(counts[scale] == (2 if scale < 3.0 else 0) for scale in observer_trials.SCALES)


@pytest.mark.slow
def test_rates_are_compared_with_and_without_mismatch(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(observer, "PUSHES", 3)
    file = tmp_path / "rates.json"
    assert bench(observer, "--minutes", "0.02", "--rate", "100", "500", "--json", file) == 0
    for hertz, found in json.loads(file.read_text())["rates"].items():
        for case in (found, found["matching"]):
            # Reported at a state, and at the second above the threshold at the earliest.
            assert 2000.0 / float(hertz) <= case["detection_latency_ms"]["p50"] <= 50.0
            assert case["missed_contacts"] == case["false_stops_per_hour"] == 0
