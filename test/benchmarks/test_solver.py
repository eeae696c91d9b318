"""The solver benchmark compares solvers on the same states."""

import json

import numpy as np
import pytest
from contact_reach_command import bench

from benchmarks import pictures
from benchmarks.baselines.solvers import SOLVERS
from benchmarks.population import bench_population
from benchmarks.solver import LABELS, bench_solver, excess
from benchmarks.solver_steps import PRESETS, bench_solver_steps
from contact_reach_ros.planning.settings import PlanningSettings

SMALL = PlanningSettings(population=16, horizon=1, substeps=2)


@pytest.mark.slow
def test_every_solver_lowers_the_cost_and_a_warm_start_is_a_lead(tmp_path):
    bench_solver(["free"], 4, 0.03, file=tmp_path / "report.json", settings=SMALL)
    assert bench(pictures, tmp_path / "report.json", tmp_path / "race.png") == 0
    race = json.loads((tmp_path / "report.json").read_text())["scenes"]["free"]
    for name in LABELS:
        curves = {start: [entry["mean"] for entry in race[start][name]["curve"]] for start in ("cold", "warm")}
        for curve in curves.values():
            assert curve == sorted(curve, reverse=True) and curve[-1] >= 0.0
        assert curves["cold"][-1] < curves["cold"][0]
        assert curves["warm"][0] < curves["cold"][0]


def test_a_step_counts_once_it_has_ended():
    found = excess([np.array([3.0, 2.0, 1.5])], [1.0], 0.01, [0.0, 0.009, 0.01, 0.02, 0.5])
    assert found.tolist() == [[2.0, 2.0, 1.0, 0.5, 0.5]]


@pytest.mark.slow
def test_ten_steps_of_every_solver_lower_the_cost(capsys):
    found = bench_solver_steps(["free"], 4, settings=SMALL)["free"]
    assert (found["states"], found["states_with_contact"]) == (4, 0)
    for configuration in PRESETS:
        for name in SOLVERS:
            entry = found[configuration][name]
            low, high = entry["ci95"]
            assert 0.0 < low <= entry["mean"] <= high
        assert found[configuration]["hybrid"]["share"]["mean"] == 1.0
    assert capsys.readouterr().out.count("| free |") == len(PRESETS) * len(SOLVERS)


@pytest.mark.slow
def test_steps_are_timed_for_each_number_of_candidates(capsys):
    report = bench_population(["free"], [16, 64], 2, settings=SMALL)
    assert [row["candidates"] for row in report["rows"]] == [16, 64]
    assert all(row["decrease"] > 0.0 for row in report["rows"])
    assert report["device"] in capsys.readouterr().out
