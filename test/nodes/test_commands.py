"""Whether a goal is taken; the commands themselves run in test_doctor.py, beside its stack."""

import pytest

from contact_reach_ros.planning.goal_progress import GoalPhase, GoalState
from contact_reach_ros.ros.client import judge_goal

BEFORE = {"plans accepted": "7"}
RUNNING = GoalState(GoalPhase.RUNNING)


@pytest.mark.parametrize("state", [None, GoalState(GoalPhase.ACCEPTED), RUNNING])
def test_a_goal_is_open_until_its_plans_are_judged(state):
    assert judge_goal(state, BEFORE, BEFORE) is None


def test_a_goal_is_taken_when_the_controller_follows_plans_for_it():
    later = {"plans accepted": "8"}
    assert judge_goal(RUNNING, BEFORE, later).done
    assert judge_goal(None, BEFORE, later) is None, "these are plans for another goal"


@pytest.mark.parametrize("phase", [GoalPhase.REFUSED, GoalPhase.WITHDRAWN, GoalPhase.TIMED_OUT])
def test_a_goal_that_the_planner_does_not_pursue_comes_with_its_reason(phase):
    outcome = judge_goal(GoalState(phase, "out of reach"), BEFORE, BEFORE)
    assert not outcome.done and f"{phase.value}: out of reach" in outcome.text


@pytest.mark.parametrize("what", ["references", "plans"])
def test_plans_that_the_controller_refuses_come_with_its_reason(what):
    outcome = judge_goal(RUNNING, BEFORE, {**BEFORE, f"refused {what}": "1", f"last refusal of {what}": "other gains"})
    assert not outcome.done and "other gains" in outcome.text
