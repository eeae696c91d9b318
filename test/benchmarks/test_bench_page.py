"""The page of results: what it takes, and how tables come into it."""

import json

import pytest
from contact_reach_command import contact_reach
from test_bench_clutter import EPISODES, NAMES
from test_claims import record

from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.experiments import bench_page
from contact_reach_ros.experiments.bench_arms import arm_benches, arm_episodes, arms_table
from contact_reach_ros.experiments.bench_clutter import Clutter
from contact_reach_ros.experiments.bench_page import PARTS, Part, in_small, plan_table, replaced
from contact_reach_ros.experiments.clutter_scenes import FIRST_HELD_OUT


def hours(text):
    return float(text.splitlines()[-1].split("|")[4])


@pytest.mark.parametrize(("small", "most"), [(False, 6.0), (True, 10.0 / 60.0)])
def test_the_whole_page_takes_half_a_day_on_one_core_and_ten_minutes_on_two_in_small(small, most, tmp_path):
    parts = [in_small(part) for part in PARTS if part.is_in_quick] if small else PARTS
    text = plan_table(parts, tmp_path, ["arms", "floor", "fig5"], small)
    assert 0.3 * most < hours(text) <= most, text


def test_nothing_is_tuned_on_the_targets_of_the_tables():
    held_out = next(part.bench for part in PARTS if part.name == "clutter")
    assert (held_out.seed, held_out.scenes) == (FIRST_HELD_OUT, 100)
    targets = {part.name: {cell.target for cell in part.bench.cells} for part in PARTS}
    for name in targets.keys() - {"clutter", "tuning", "clutter_hinge", "clutter_linear", "weights", "gains", "nodes"}:
        assert not targets[name] & (targets["weights"] | set(range(20)))
    assert all(cell.target < FIRST_HELD_OUT for part in PARTS for cell in in_small(part).bench.cells)


def test_text_between_marks_is_replaced_and_nothing_else():
    page = "a\n<!-- one -->\nold\n<!-- /one -->\nb\n<!-- two -->\n<!-- /two -->\nc\n"
    made = replaced(page, {"one": "new | \\1", "three": "x"})
    assert made == "a\n<!-- one -->\n\nnew | \\1\n\n<!-- /one -->\nb\n<!-- two -->\n<!-- /two -->\nc\n"
    assert replaced(made, {"one": "old"}) == replaced(page, {"one": "old"})


def test_an_unfinished_run_is_reported_as_far_as_it_is(tmp_path, monkeypatch, capsys):
    """Two whole scenes and one that a method is missing in."""
    bench = Clutter(scenes=3, seed=0, methods=NAMES)
    monkeypatch.setattr(bench_page, "PARTS", (Part("clutter", bench, 1.0),))
    report = {"bench": "clutter", "command": bench.command, "episodes": EPISODES[:-1]}
    (tmp_path / "clutter.json.partial").write_text(json.dumps(report))
    page = tmp_path / "page.md"
    page.write_text("# Page\n<!-- clutter -->\n<!-- /clutter -->\n")
    assert contact_reach("bench", "page", "--out", tmp_path, "--report-only", "--write", page) == 0
    assert "Not finished: 8 of 9 episodes" in page.read_text()
    assert f"`{bench.command}`: 2 scenes." in page.read_text()
    assert "| **contact_reach** | 100 %" in page.read_text()
    assert (tmp_path / "clutter.png").stat().st_size > 10_000
    assert contact_reach("bench", "page", "--out", tmp_path, "--dry-run") == 0
    assert "| clutter | 9 | 1 |" in capsys.readouterr().out


def test_parts_that_there_are_not_are_refused(tmp_path, capsys):
    assert contact_reach("bench", "page", "--out", tmp_path, "--parts", "table1") == 2
    assert "--parts 'table1' is unknown; expected some of clutter, tuning, clutter_hinge" in capsys.readouterr().err


def test_every_arm_is_run_among_balls_and_in_walls_where_it_can_dodge():
    benches = arm_benches()
    assert {bench.arm for bench in benches.values()} == set(ARMS)
    for arm in ARMS:
        scenes = {(*bench.scenes, bench.task) for bench in benches.values() if bench.arm == arm}
        assert ("wall", "pose") in scenes if load_arm(arm).n == 7 else ("ball", "position") in scenes
        assert {("free", "pose"), ("ball", "pose")} <= scenes
    assert all("collision_free" in bench.methods for bench in benches.values() if bench.scenes != ("free",))
    assert {cell.target for bench in benches.values() for cell in bench.cells} == set(range(10))


def test_the_table_of_arms_shows_what_there_is_and_how_much_is_missing(tmp_path, capsys):
    def episode(method, target, time, force, stop=""):
        made = record("ball", method=method, target=target, max_contact_force=force, timing={"plan_s": 0.02})
        return {**made, **({"time": time, "reached": True, "time_ratio": time} if time else {}), "stop_reason": stop}

    found = [episode("contact_reach", 0, 1.2, 0.0), episode("contact_reach", 1, 1.4, 3.0)]
    found += [episode("reference_posture", 0, None, 8.0, "observer: limit")]
    folder = tmp_path / "arms"
    folder.mkdir()
    (folder / "panda_ball_pose.json.partial").write_text(json.dumps({"bench": "table1", "episodes": found}))
    text = arms_table(folder)
    assert "| `panda` | pose | ball | contact_reach | 2/2 | 0 | 1.30 (1.40) | 1.50 (3.00) | 20 |" in text
    assert "| `panda` | pose | ball | reference_posture | 0/1 | 1 | – | 8.00 (8.00) | 20 |" in text
    whole, left, seconds = arm_episodes(folder, quick=False)
    assert whole - left == 3 and f"{left} episodes are missing" in text and seconds > 8.0 * left
    assert contact_reach("bench", "page", "--out", tmp_path, "--parts", "arms", "--dry-run") == 0
    assert f"| arms | {whole} | {left} |" in capsys.readouterr().out
    assert arms_table(tmp_path) == ""
