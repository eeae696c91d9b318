"""The planner benchmark measures what it promises; not how fast this machine is."""

import json
import math

import pytest
from contact_reach_command import contact_reach

from benchmarks.planner import PlannerBench

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> dict:
    file = tmp_path_factory.mktemp("bench") / "report.json"
    assert contact_reach("bench", "planner", "--quick", "--scene", "free", "--seed", "3", "--json", file) == 0
    return json.loads(file.read_text())


def test_report_has_the_promised_keys(measured):
    scene = measured["free"]
    assert set(scene["solve_ms"]) == {"p50", "p95", "max"}
    for key in ("step_ms", "steps"):
        assert scene[key]["p50"] > 0.0
    assert scene["rollout_us_per_substep"] > 0.0
    assert scene["torque_planning_ratio"] > 0.0
    assert set(scene["plan_error"]) == {"position_mm", "rotation_deg", "joint_deg"}
    assert {"cpu", "cores", "jax", "brax", "seed"} <= set(measured["machine"])
    assert measured["machine"]["seed"] == 3


def test_percentiles_are_in_order(measured):
    for values in (measured["free"]["solve_ms"], measured["free"]["plan_error"]["position_mm"]):
        assert 0.0 <= values["p50"] <= values["p95"] <= values["max"] < math.inf


def test_parts_are_shorter_than_the_whole(measured):
    """A step is part of a solve, and a batch of candidates is part of a step."""
    scene = measured["free"]
    assert scene["rollout_batch_ms"] < scene["step_ms"]["max"]
    assert scene["step_ms"]["p50"] * scene["steps"]["p50"] < 2 * scene["solve_ms"]["max"]


def test_plans_come_from_a_closed_loop_that_the_planner_can_predict(measured):
    scene = measured["free"]
    assert scene["plans"] >= PlannerBench.quick(("free",), 3).plans
    assert scene["episodes"] == 1
    assert scene["plan_error"]["position_mm"]["p50"] < 2.0
    assert scene["plan_error"]["rotation_deg"]["p50"] < 2.0


def test_torques_and_references_are_planned_in_closed_loops(measured):
    references, torques = (measured["free"]["torque_planning"][name]["plan_s"] for name in ("references", "torques"))
    assert measured["free"]["torque_planning_ratio"] == pytest.approx(torques / references)
    assert references > 0.0


def test_unknown_scene_is_refused(capsys):
    assert contact_reach("bench", "planner", "--quick", "--scene", "nowhere") == 2
    assert "nowhere" in capsys.readouterr().err


def test_batches_are_measured_for_each_number_of_candidates(tmp_path, capsys):
    file = tmp_path / "report.json"
    command = ["bench", "planner", "--quick", "--scene", "free", "--candidates", "64", "8", "--json", file]
    assert contact_reach(*command) == 0
    measured = json.loads(file.read_text())["free"]["candidates"]
    assert list(measured["batch_ms"]["closed_loop"]) == ["8", "64"]
    assert all(value > 0.0 for value in measured["batch_ms"]["closed_loop"].values())
    assert f"| free | {measured['device']} | closed_loop | 64 |" in capsys.readouterr().out
