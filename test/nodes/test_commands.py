"""What became of a goal, read from diagnostics; the commands themselves run in test_doctor.py, beside its stack."""

import pytest

from contact_reach_ros.bringup.commands import judge_goal

BEFORE = {"planner": {"goals": "2", "refused goals": "1"}, "controller": {"plans accepted": "7"}}


def now(node, **values):
    return {**BEFORE, "planner": {"goals": "3"}, node: {**BEFORE[node], "goals": "3", **values}}


@pytest.mark.parametrize("later", [BEFORE, now("planner")])
def test_a_goal_is_open_until_its_plans_are_judged(later):
    assert judge_goal(BEFORE, later) is None


def test_a_goal_is_taken_when_the_controller_follows_plans_for_it():
    assert judge_goal(BEFORE, now("controller", **{"plans accepted": "8"})).done


def test_a_refused_goal_comes_with_the_planners_reason():
    values = {"refused goals": "2", "last refusal of goals": "out of reach"}
    outcome = judge_goal(BEFORE, {**BEFORE, "planner": {**BEFORE["planner"], **values}})
    assert not outcome.done and "out of reach" in outcome.text


@pytest.mark.parametrize("what", ["references", "plans"])
def test_plans_that_the_controller_refuses_come_with_its_reason(what):
    outcome = judge_goal(
        BEFORE, now("controller", **{f"refused {what}": "1", f"last refusal of {what}": "other gains"})
    )
    assert not outcome.done and "other gains" in outcome.text
