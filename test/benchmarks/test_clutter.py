"""Random scenes: the same from the same seed, and what the report makes of their episodes."""

import pytest
from arm_simulation import ARM
from contact_reach_command import bench
from test_claims import record
from test_grid import TINY

from benchmarks import pictures
from benchmarks.clutter import Clutter, bench_clutter, clutter_table, summary
from benchmarks.clutter_scenes import MAX_BODIES, clutter_scene
from contact_reach_ros.scenes.generate import conflict, make_scene
from contact_reach_ros.simulation.robot import SimulatedRobot


def test_a_seed_fixes_the_scene_and_seeds_differ():
    assert clutter_scene(ARM, 3) == clutter_scene(ARM, 3)
    scenes = [clutter_scene(ARM, seed) for seed in range(12)]
    counts = [len(scene.obstacles) for scene in scenes]
    assert min(counts) >= 1
    assert max(counts) <= MAX_BODIES
    assert len(set(counts)) > 3
    stiffness = [getattr(body, "stiffness", 0) or body.edge_stiffness for scene in scenes for body in scene.obstacles]
    assert 50 <= min(stiffness) < 150 < 700 < max(stiffness) <= 2000


def test_scenes_are_those_of_a_range_or_of_a_list():
    for clutter, seeds in ((Clutter(scenes=2, seed=7), [7, 8]), (Clutter(only=(9, 4)), [9, 4])):
        assert [cell.target for cell in clutter.cells][:: len(clutter.methods)] == seeds


def test_scenes_begin_free_of_contact_and_can_be_simulated():
    for seed in range(3):
        scene = make_scene(clutter_scene(ARM, seed), ARM, seed)
        assert not conflict(scene)
        plant = SimulatedRobot(scene).plant
        plant.step()
        assert plant.contact_forces().max() == 0.0


def entry(method, scene, force=None, time=None, entered=None):
    figures = {"max_contact_force": force, "mean_contact_force": force, "contact_impulse": force, "time_ratio": time}
    if time is not None:
        figures["time"] = time
    made = record(f"clutter_{scene}", method=method, target=scene, **figures)
    return {**made, "entry_time": entered if entered is not None else time}


EPISODES = [
    # Only contact gets there.
    entry("contact_reach", 0, 1.0, 3.0), entry("reference_posture", 0, 5.0, 3.0), entry("collision_free", 0),
    # Everything does; the forces are equal, and the path is slower.
    entry("contact_reach", 1, 0.0, 3.0), entry("reference_posture", 1, 0.05, 2.0), entry("collision_free", 1, 0.0, 9.0),
    # The method is only first there.
    entry("contact_reach", 2, 4.0, None, 2.0), entry("reference_posture", 2, 7.0), entry("collision_free", 2, 0.0, 6.0),
]  # fmt: skip
NAMES = ("contact_reach", "reference_posture", "collision_free")


def test_the_summary_counts_what_settles_who_is_best_and_how_often_contact_was_needed():
    found = summary(EPISODES, NAMES)
    methods = found["methods"]
    assert found["scenes"] == 3
    assert methods["contact_reach"]["entered"]["mean"] == 1.0
    assert methods["contact_reach"]["success"]["mean"] == pytest.approx(2 / 3)
    assert methods["contact_reach"]["settled"]["mean"] == pytest.approx(2 / 3)
    assert [methods[name]["best"]["mean"] for name in NAMES] == pytest.approx([1 / 3] * 3)
    assert methods["contact_reach"]["peak_force_N"]["mean"] == pytest.approx(5 / 3)
    assert found["contact_needed"]["mean"] == pytest.approx(1 / 3)
    low, high = found["contact_needed"]["ci95"]
    assert 0.0 < low < 1 / 3 < high < 1.0
    text = clutter_table({"command": "python -m benchmarks.clutter", **found})
    assert "| **contact_reach** | 100 %" in text
    assert "Collision-free planning fails and contact gets the arm there in 33 %" in text
    # Compared where both settle.
    against = methods["reference_posture"]["against"]
    assert against["peak_force_N"]["mean"] == pytest.approx((4.0 + 0.05) / 2)
    assert against["time_s"]["mean"] == pytest.approx(-0.5)


@pytest.mark.slow
def test_a_tiny_run_has_the_whole_report(tmp_path, capsys):
    tiny = Clutter(scenes=1, seed=4, methods=("reactive",), foam_factor=2.0)
    file, picture = tmp_path / "clutter.json", tmp_path / "clutter.png"
    report = bench_clutter(tiny, file, workers=1, setup=TINY)
    assert set(report["methods"]) == {"reactive"}
    for found in report["methods"].values():
        assert {"entered", "settled", "success", "time_ratio", "peak_force_N", "impulse_Ns"} <= set(found)
    assert report["scenes"] == 1
    assert report["command"].endswith("--methods reactive --foam-factor 2.0")
    assert "| reactive |" in capsys.readouterr().out
    assert bench(pictures, file, picture) == 0
    assert picture.stat().st_size > 10_000
