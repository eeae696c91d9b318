"""Stems in simulation and planner, measured."""

import json

import pytest

from benchmarks.stems import bench_stems
from contact_reach_ros.errors import SceneError


def test_pushes_across_a_stem_meet_the_force_that_the_planner_expects(tmp_path, capsys):
    report = bench_stems(pushes=6, file=tmp_path / "stems.json")
    assert json.loads((tmp_path / "stems.json").read_text()) == report
    assert len(report["force_N"]) == 6 and max(report["depth_m"]) <= 0.07
    assert "all: 6 pushes" in capsys.readouterr().out


def test_a_scene_without_a_plant_is_refused():
    with pytest.raises(SceneError, match="'ball' has no plant"):
        bench_stems("ball")
