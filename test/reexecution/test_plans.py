"""Bags whose plans cannot be re-executed."""

from types import SimpleNamespace

import numpy as np
import pytest

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.reexecution import plans as plans
from contact_reach_ros.reexecution.command import DIFFERENT, IDENTICAL, run_reexecution
from contact_reach_ros.reexecution.inputs import RecordedInputs, Row
from contact_reach_ros.reexecution.plan_outcome import PlanDifference, ReexecutedPlan, compare_plans
from contact_reach_ros.reexecution.plans import RecordedPlans
from contact_reach_ros.resources import share_directory


def test_a_bag_of_an_earlier_version_is_refused_and_says_what_to_do(monkeypatch):
    """Without `approach` its planner's weight of contact is unknown: plans would differ without a reason to be seen."""
    solutions = {1: {"plan": np.ones(1), "best": np.zeros(39)}}
    monkeypatch.setattr(plans, "_read_plans", lambda _: ({1: {"plan": "1"}}, {1: 0}, solutions))
    bag = SimpleNamespace(summary=SimpleNamespace(path="old_bag"))
    inputs = SimpleNamespace(bag=bag, intakes={"planner": []}, settings={"planner": {}})
    with pytest.raises(BagError, match=r"old_bag.*earlier version.*use that version"):
        RecordedPlans(inputs)


def test_rivals_withdraw_the_goal_as_they_did():
    withdrawn = []
    planner = SimpleNamespace(withdraw=lambda: withdrawn.append(True))
    recorded = SimpleNamespace(_inputs=None)
    RecordedPlans._take(recorded, planner, None, Row(Taken.STOP, 0, 0, False, 0))
    assert withdrawn


@pytest.mark.parametrize(("threads", "warnings"), [(None, 1), ("2", 1), ("1", 0)])
def test_several_threads_in_lapack_bring_a_warning(monkeypatch, caplog, threads, warnings):
    """They change the last digits of plans among deformable bodies; nodes and command line have one."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if threads is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", threads)
    RecordedPlans(RecordedInputs(BagReader(share_directory() / "bags" / "sample")))
    assert len(caplog.messages) == warnings
    assert all("OPENBLAS_NUM_THREADS is not 1" in message for message in caplog.messages)


PLAN = {"steps": np.array([4.0]), "cost": np.array([0.1]), "best": np.array([0.5, -20.0])}


@pytest.mark.parametrize(
    ("changed", "field", "largest"),
    [
        ({}, None, 0.0),
        ({"cost": np.array([0.1 + 9e-8])}, None, 9e-8),
        ({"best": np.array([0.5, -20.0 - 1e-6])}, None, 5e-8),
        ({"cost": np.array([0.1 + 9e-8]), "best": np.array([0.5 + 3e-7, -20.0])}, "best[0]", 9e-8),
        ({"steps": np.array([5.0])}, "steps", 0.0),
        ({"cost": np.array([np.nan])}, "cost", 0.0),
        ({"best": np.zeros(3)}, "number of best", 0.0),
        ({"positions": np.zeros(3)}, "number of positions", 0.0),
    ],
)
def test_plans_of_another_processor_are_equal_within_rounding(changed, field, largest):
    difference, off = compare_plans(3, PLAN, {**PLAN, **changed}, 1e-7)
    assert (None if difference is None else difference.field) == field
    assert off == pytest.approx(largest, rel=1e-6)


@pytest.mark.parametrize(
    ("difference", "rounding", "says", "code"),
    [
        (None, 0.0, "identical, bit for bit", IDENTICAL),
        (None, 3e-8, "equal within rounding (1e-07", IDENTICAL),
        (PlanDifference(3, "cost", 0.1, 0.2), 3e-8, "DIFFERENT: plan 3, cost: recorded 0.1", DIFFERENT),
    ],
)
def test_the_command_says_how_far_a_plan_is_off(monkeypatch, capsys, difference, rounding, says, code):
    plan = SimpleNamespace(
        steps=4, cost=0.1, cost_terms={}, predicted_contact_forces=np.zeros(1), positions=np.zeros((3, 3))
    )
    found = ReexecutedPlan(3, plan, {}, 1, difference, rounding, 0.1)
    monkeypatch.setattr(RecordedPlans, "solve", lambda *_: found)
    assert run_reexecution(share_directory() / "bags" / "sample", plan=3) == code
    assert says in capsys.readouterr().out
