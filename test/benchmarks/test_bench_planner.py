"""The planner's benchmark measures what it promises; not how fast this machine is."""

import json

import pytest

from benchmarks import planner
from benchmarks.paper import JOINT_TORQUE, METHOD
from benchmarks.planner import PlannerBench, bench_planner
from contact_reach_ros.planning.settings import PlanningSettings

TINY = PlanningSettings(deadline=0.0, population=16, horizon=1, max_steps=3, substeps=2)


@pytest.mark.slow
def test_torques_and_references_are_planned_in_closed_loops(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(planner, "_CLOSED_LOOP_S", 1.0)
    file = tmp_path / "planner.json"
    bench_planner(PlannerBench(("free",), targets=1, seed=3, settings=TINY), file)
    report = json.loads(file.read_text())
    found = report["scenes"]["free"]
    for method in (METHOD, JOINT_TORQUE):
        assert found[method]["plans"] >= 5
        assert 1.0 <= found[method]["steps"] <= TINY.max_steps
        assert found[method]["step_ms"] * found[method]["steps"] == pytest.approx(found[method]["plan_ms"])
    assert found["torque_planning_ratio"] == pytest.approx(found[JOINT_TORQUE]["plan_ms"] / found[METHOD]["plan_ms"])
    assert {episode["target"] for episode in report["episodes"]} == {3}
    assert f"| free | {METHOD} |" in capsys.readouterr().out
