"""The foam bench reports what it measured, for scenes that have foam."""

import dataclasses
import json

import pytest
from arm_simulation import ARM, with_obstacle
from bench_command import bench

from benchmarks import foam
from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import read_scene


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
        foam.bench_foam("ball", 0, 10.0, False, None)


@pytest.mark.parametrize("force", ["0", "-1", "101", "nan", "inf"])
def test_force_out_of_range_is_refused(force, capsys):
    assert bench(foam, "--force", force) == 2
    assert f"force = {force} N: expected a number above 0, at most 100" in capsys.readouterr().err


def pressed(scene: Scene, force: float = 10.0) -> list[foam.Press]:
    return [foam.press(scene, force, *node) for node in ((0, 5, 0), (0, 0, 0), (1, 2, 1))]


def in_use(scene: Scene, scale: float) -> Scene:
    """The scene with another stiffness for the planner, and the same foam in the plant."""
    walls = tuple(
        dataclasses.replace(wall, material=dataclasses.replace(wall.material, planner_scale=scale))
        for wall in scene.obstacles
    )
    return dataclasses.replace(scene, obstacles=walls)


def walls_of(**changes) -> Scene:
    return make_scene(with_obstacle(read_scene("wall"), **changes), ARM, 0)


class TestFit:
    def test_foam_that_hardens_more_is_agreed_with_again(self):
        scene = walls_of(hardening=5.0)
        presses = pressed(scene)
        assert max(abs(row["ratio"] - 1.0) for row in presses) > 0.3
        scale = foam.fit_scale(scene, 10.0, presses)
        assert scale > 1.2
        assert all(abs(row["ratio"] - 1.0) < 0.2 for row in pressed(in_use(scene, scale)))

    @pytest.mark.parametrize("foam_scale", [0.5, 2.0])
    def test_stiffness_of_foam_that_does_not_harden_is_found(self, foam_scale):
        scene = dataclasses.replace(walls_of(hardening=0.0), foam_scale=foam_scale)
        assert foam.fit_scale(scene, 10.0, pressed(scene)) == pytest.approx(foam_scale, rel=0.02)
