"""The observer bench reports what it measured."""

import json

import numpy as np
import pytest
from contact_reach_command import bench

from benchmarks import observer


@pytest.mark.slow
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
