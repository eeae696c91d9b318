"""Episodes for each value of a setting."""

import json

import pytest
from contact_reach_command import bench

from benchmarks import pictures, setting
from benchmarks.setting import Sweep, best


@pytest.mark.slow
def test_slower_planning_makes_the_arm_slower(tmp_path, capsys):
    """x_d is latched with every plan, so fewer plans move it less far; ratios are those of settling at the goal."""
    file = tmp_path / "report.json"
    assert bench(setting, "latency", "0.04", "0.1", "--scenes", "free", "--targets", "1", "--json", file) == 0
    fast, slow = json.loads(file.read_text())["scenes"]["free"]
    assert (fast["value"], slow["value"]) == (0.04, 0.1)
    assert fast["reached"] == slow["reached"] == 1
    assert 1.0 < fast["time_ratio"]["mean"] < 0.9 * slow["time_ratio"]["mean"]
    assert fast["largest_force"]["mean"] == 0.0
    assert "| free | contact_reach | 0.04 | 1/1 |" in capsys.readouterr().out
    assert bench(pictures, file, tmp_path / "report.png") == 0


def test_each_target_has_random_numbers_of_its_own_and_the_same_for_each_value():
    sweep = Sweep("latency", (0.04, 0.1), ("free",), targets=2)
    cells = [(cell.target, cell.repeat, cell.variant) for cell in sweep.cells]
    assert cells == [(0, 0, "0.04"), (0, 0, "0.1"), (1, 0, "0.04"), (1, 0, "0.1")]
    assert [setup.latency("contact_reach") for setup in sweep.variants.values()] == [0.04, 0.1]


def row(value, reached, ratio, force):
    means = {"time_ratio": {"mean": ratio}, "largest_force": {"mean": force}}
    return {"value": value, "targets": 4, "reached": reached, **means}


def test_the_best_value_presses_least_among_those_that_are_sure_and_quick():
    rows = [row(0, 4, 1.1, 8.0), row(0.01, 4, 1.2, 1.2), row(0.05, 4, 1.9, 1.0), row(5, 0, float("nan"), 0.0)]
    assert best(rows) == 0.01
    assert best(rows[3:]) is None
