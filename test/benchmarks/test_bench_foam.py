"""The foam bench reports what it measured, for scenes that have foam."""

import json

import pytest
from contact_reach_command import bench

from benchmarks import foam


def test_report_holds_every_node(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(foam, "_PRESS_TICKS", 300)
    monkeypatch.setattr(foam, "_surface_nodes", lambda _: [(0, 5, 0), (1, 5, 1)])
    file = tmp_path / "foam.json"
    assert bench(foam, "--json", file) == 0
    report = json.loads(file.read_text())
    assert [row["node"] for row in report["press"]] == [[0, 5, 0], [1, 5, 1]]
    for row in report["press"]:
        assert row["ratio"] == pytest.approx(row["plant_mm"] / row["planner_mm"])
        assert row["ratio"] == pytest.approx(1.0, abs=0.2)
        assert row["time_ratio"] == pytest.approx(1.0, abs=0.3)
    assert "ratio" in capsys.readouterr().out
