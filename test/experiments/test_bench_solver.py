"""The solver benchmark compares the three methods on the same states."""

import json

import pytest
from contact_reach_command import contact_reach

from contact_reach_ros.experiments.bench_solver import STARTS, bench_solver
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver import SOLVERS

pytestmark = pytest.mark.slow

SMALL = PlanningSettings(population=16, elite=4, line_search_points=16, horizon=1, substeps=2, gradient_steps=2)


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> dict:
    file = tmp_path_factory.mktemp("bench") / "report.json"
    bench_solver("free", 4, file, SMALL)
    return json.loads(file.read_text())


def test_every_method_lowers_the_cost(measured):
    for method in SOLVERS:
        entry = measured[method]
        assert entry["decrease"] > 0.0
        assert entry["ms"] > 0.0
        low, high = entry["ci95"]
        assert low <= entry["decrease"] <= high


def test_decrease_grows_with_the_steps(measured):
    for method in SOLVERS:
        curve = measured[method]["decrease_by_step"]
        assert curve[0] == 0.0
        assert curve == sorted(curve)
        assert curve[-1] == pytest.approx(measured[method]["decrease"])


def test_more_starts_are_never_worse_and_take_longer(measured):
    starts = [measured["multi_start"][str(count + 1)] for count in range(STARTS)]
    assert [entry["decrease"] for entry in starts] == sorted(entry["decrease"] for entry in starts)
    assert starts[0]["decrease"] == pytest.approx(measured["hybrid"]["decrease"], abs=1e-6)
    assert starts[0]["ms"] < starts[-1]["ms"]


def test_states_are_those_of_the_free_scene(measured):
    assert (measured["scene"], measured["states"], measured["states_with_contact"]) == ("free", 4, 0)


def test_one_seed_is_refused(capsys):
    assert contact_reach("bench", "solver", "--seeds", "1") == 2
    assert "at least 2" in capsys.readouterr().err
