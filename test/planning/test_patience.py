"""Permitted contact counts for less and less where it holds the arm up."""

import math

import numpy as np
import pytest
from arm_simulation import HOME
from planning_helpers import make_planner
from test_receding_horizon import FLANGE, MS, ball_at, plan_from

from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Approach
from contact_reach_ros.world.goal import Target

SPEED = 0.02


def share_after(distances, step=0.04, patience=0.5, least_speed=SPEED):
    approach = Approach.begin(distances[0])
    for distance in distances[1:]:
        approach = approach.updated(distance, step, patience, least_speed)
    return approach.share


def test_standing_still_costs_a_factor_e_with_each_patience():
    assert share_after(np.full(26, 0.3), step=0.04, patience=0.5) == pytest.approx(math.exp(-2.0), rel=1e-4)


def test_what_counts_is_the_mean_speed_of_approach():
    times = 0.04 * np.arange(100)
    swaying = 0.002 * np.sin(40.0 * times)
    assert share_after(0.3 - 1.1 * SPEED * times) == 1.0
    assert share_after(0.3 - 0.5 * SPEED * times + swaying) < 0.1
    assert share_after(0.3 + SPEED * times[:20]) < 0.5 * share_after(np.full(20, 0.3))


def test_the_share_comes_back_as_the_arm_catches_up_and_never_exceeds_one():
    behind = np.full(20, 0.3)
    caught_up = 0.3 - 4.0 * SPEED * 0.04 * np.arange(1, 9)
    assert share_after(behind) < 0.3 < 0.99 < share_after(np.append(behind, caught_up))
    ahead = 0.3 - 4.0 * SPEED * 0.04 * np.arange(50)
    assert share_after(ahead) == 1.0
    # It is not ahead by what it has gained before.
    assert share_after(np.append(ahead, np.full(19, ahead[-1]))) == pytest.approx(share_after(behind), rel=1e-4)


def test_a_planner_gives_in_for_one_goal_only():
    planner, spheres = make_planner(contact_patience=0.1), ball_at(np.array([0.0, 0.0, -1.0]))
    goal, other = (Target(FLANGE + np.array(offset)) for offset in ((0.2, 0.0, 0.1), (0.0, 0.2, 0.1)))
    # The arm is told to be where it was, again and again.
    shares = []
    for time in range(0, 400, 40):
        plan_from(planner, state=time, effect=time, goal=goal, spheres=spheres)
        shares.append(planner.memory.approach.share)
    assert shares[0] == 1.0 and shares[-1] < 0.1
    plan_from(planner, state=400, effect=400, goal=other, spheres=spheres)
    assert planner.memory.approach.share == 1.0
    plan_from(planner, state=440, effect=440, goal=other, spheres=spheres)
    assert planner.memory.approach.share < 1.0
    planner.reset()
    plan_from(planner, state=480, effect=480, goal=other, spheres=spheres)
    assert planner.memory.approach.share == 1.0


def test_the_share_comes_back_while_contact_is_firm():
    held_up = Approach(0.3, 0.1)
    assert held_up.updated(0.3, 0.5, 0.5, SPEED, is_firm=True).share == pytest.approx(0.1 * math.e)
    # No slower than without.
    assert held_up.updated(0.26, 0.5, 0.5, SPEED, is_firm=True) == held_up.updated(0.26, 0.5, 0.5, SPEED)


def test_the_weight_is_what_falls():
    """One and the same contact, the first time and after the arm was held up for a while."""
    rest = np.zeros(7)
    planner = make_planner(contact_patience=0.1)
    down = np.array([0.0, 0.0, -1.0])
    goal, spheres = Target(FLANGE + 0.3 * down), ball_at(FLANGE + 0.13 * down)

    def weight(time: int) -> float:
        plan = planner.plan(Request(HOME, rest, time * MS, time * MS, goal, spheres))
        force = plan.predicted_contact_forces.max(axis=1).sum()
        return plan.cost_terms["contact"] / force if force else math.nan

    weights = [weight(time) for time in range(0, 800, 40)]
    found = [value for value in weights if not math.isnan(value)]
    assert len(found) > 5
    full = PlanningSettings().contact_weight
    assert max(found) <= full * 1.001
    assert found[-1] < 0.1 * full
