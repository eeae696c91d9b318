"""The observer bench reports what it measured."""

import json
import math

import numpy as np
import pytest

from contact_reach_ros.cli import main
from contact_reach_ros.experiments import bench_observer
from contact_reach_ros.experiments.free_motion import START, FreeMotion
from contact_reach_ros.observer.budget import ContactBudget


def test_report_holds_what_it_should(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_observer, "PUSHES", 6)
    file, plot = tmp_path / "observer.json", tmp_path / "roc.png"
    with pytest.raises(SystemExit) as ended:
        main(["bench", "observer", "--minutes", "0.05", "--json", str(file), "--plot", str(plot)])
    assert ended.value.code == 0
    report = json.loads(file.read_text())
    assert abs(report["step_63_error"]) < 0.05
    assert 0.0 < report["free_rms_nm"]["max"] < 10.0
    latency = report["detection_latency_ms"]
    assert 1.0 <= latency["p50"] <= latency["p95"] <= latency["max"] <= 100.0
    assert report["pushes"] == 6
    assert report["missed_contacts"] <= 1
    assert report["false_stops_per_hour"] == 0.0
    # The higher the thresholds, the less is seen, rightly or falsely.
    assert np.all(np.diff(report["roc"]["seen_share"]) <= 0.0)
    assert report["roc"]["seen_share"][0] == 1.0
    assert plot.stat().st_size > 1000
    assert "6 pushes of 50 N at mid-arm" in capsys.readouterr().out


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "inf"])
def test_minutes_out_of_range_are_refused(minutes, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["bench", "observer", "--minutes", minutes])
    assert ended.value.code == 2
    assert f"minutes = {minutes}: expected a number above 0" in capsys.readouterr().err


def test_stop_in_free_motion_is_counted_and_named(monkeypatch):
    # With thresholds below the noise the arm is stopped as soon as it is watched.
    monkeypatch.setattr(bench_observer, "_EPISODE_S", 2.0)
    budget = ContactBudget(torque_thresholds=(0.5,) * 7, torque_per_speed=(0.0,) * 7)
    run = bench_observer.move_freely(bench_observer.MismatchSettings(), 0.02, budget)
    assert len(run.stops) >= 1
    assert "seed 0, 0.5" in run.stops[0]
    assert "external torque on lbr_A2" in run.stops[0]


def test_push_acts_through_the_axis_of_its_link_and_across():
    motion = FreeMotion(bench_observer.NO_MISMATCH, 0, ContactBudget())
    while motion.plant.time < START:
        motion.tick()
    apply, link = bench_observer._random_push(motion.plant, 50.0, np.random.default_rng(0))
    apply()
    plant = motion.plant
    body = plant.model.body(link).id
    force, moment = plant.data.xfrc_applied[body, :3], plant.data.xfrc_applied[body, 3:]
    assert np.linalg.norm(force) == pytest.approx(50.0)
    assert force @ moment == pytest.approx(0.0, abs=1e-9)
    assert link in {"lbr_link_3", "lbr_link_4", "lbr_link_5"}


def test_onsets_are_debounced_and_merged():
    ratios = [0.0] * 10 + [3.0] + [0.0] * 10 + [3.0] * 5 + [0.0] * 10 + [3.0] * 5 + [0.0] * 100 + [3.0] * 5
    counts = dict(zip(bench_observer.SCALES, bench_observer._onsets(ratios), strict=True))
    assert all(counts[scale] == (2 if scale < 3.0 else 0) for scale in bench_observer.SCALES)


def test_push_that_is_not_seen_is_missed():
    unseen = bench_observer.Push(math.nan, False, None, np.zeros(100))
    seen = bench_observer.Push(0.004, False, True, np.full(100, 2.0))
    summary = bench_observer._pushed([unseen, seen, seen])
    assert summary["missed_contacts"] == 1
    assert summary["detection_latency_ms"]["p50"] == pytest.approx(4.0)
    assert summary["link_right_share"] == 1.0
