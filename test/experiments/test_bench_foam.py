"""The foam bench reports what it measured, for scenes that have foam."""

import json

import pytest

from contact_reach_ros.cli import main
from contact_reach_ros.errors import SceneError
from contact_reach_ros.experiments import bench_foam
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import read_scene


def test_report_holds_every_node_and_the_steps(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench_foam, "_PATH_S", 0.6)
    monkeypatch.setattr(bench_foam, "_HOLD_S", 0.2)
    monkeypatch.setattr(bench_foam, "_PRESS_TICKS", 300)
    monkeypatch.setattr(bench_foam, "_surface_nodes", lambda _: [(0, 5, 0), (1, 5, 1)])
    file = tmp_path / "foam.json"
    with pytest.raises(SystemExit) as ended:
        main(["bench", "foam", "--json", str(file)])
    assert ended.value.code == 0
    report = json.loads(file.read_text())
    assert [row["node"] for row in report["press"]] == [[0, 5, 0], [1, 5, 1]]
    for row in report["press"]:
        assert row["ratio"] == pytest.approx(row["plant_mm"] / row["planner_mm"])
        assert row["ratio"] == pytest.approx(1.0, abs=0.2)
        assert row["time_ratio"] == pytest.approx(1.0, abs=0.3)
    # The arm was in contact, or nothing would have been timed.
    assert report["step_us"]["contacts"] >= 1
    assert "ratio" in capsys.readouterr().out


def test_nodes_lie_in_the_lattice_and_can_move():
    scene = make_scene(read_scene("wall"), 0)
    shape = scene.walls[-1].settings.nodes
    nodes = bench_foam._surface_nodes(scene)
    assert len(set(nodes)) == len(nodes)
    for node in nodes:
        assert all(0 <= place < count for place, count in zip(node, shape, strict=True))
        assert node[2] < shape[2] - 1


def test_scene_without_walls_is_refused():
    with pytest.raises(SceneError, match="scene 'ball' has no walls"):
        bench_foam.bench_foam("ball", 0, None)
