"""The foam bench reports what it measured, for scenes that have foam."""

import json

import pytest
from bench_command import bench

from benchmarks import foam
from contact_reach_ros.errors import SceneError


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


def test_scene_without_walls_is_refused():
    with pytest.raises(SceneError, match="scene 'ball' has no walls"):
        foam.bench_foam("ball", 0, 10.0, None)


@pytest.mark.parametrize("force", ["0", "-1", "101", "nan", "inf"])
def test_force_out_of_range_is_refused(force, capsys):
    assert bench(foam, "--force", force) == 2
    assert f"force = {force} N: expected a number above 0, at most 100" in capsys.readouterr().err
