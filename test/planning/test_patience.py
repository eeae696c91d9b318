"""Permitted contact counts for less and less where it holds the arm up."""

import dataclasses
import math

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, rotation_about
from planning_helpers import FLANGE, MS, SMALL, ball_at

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.terms import Approach
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

SPEED = 0.02
BEHIND = np.full(20, 0.3)
DOWN = np.array([0.0, 0.0, -1.0])


ORIGIN = np.zeros(3)
GOAL = Target(ORIGIN)


def at(distance: float) -> np.ndarray:
    return np.array([distance, 0.0, 0.0])


def share_after(distances) -> float:
    approach = Approach(at(distances[0]))
    for distance in distances[1:]:
        approach = approach.updated(at(distance), GOAL, elapsed=0.04, patience=0.5, least_speed=SPEED)
    return approach.share


def test_standing_still_costs_a_factor_e_with_each_patience():
    assert share_after(np.full(26, 0.3)) == pytest.approx(math.exp(-2.0), rel=1e-4)


def test_what_counts_is_the_mean_speed_of_approach():
    times = 0.04 * np.arange(100)
    swaying = 0.002 * np.sin(40.0 * times)
    assert share_after(0.3 - 1.1 * SPEED * times) == 1.0
    assert share_after(0.3 - 0.5 * SPEED * times + swaying) < 0.1
    assert share_after(0.3 + SPEED * times[:20]) < 0.5 * share_after(BEHIND)


def test_the_share_comes_back_as_the_arm_catches_up_and_never_exceeds_one():
    caught_up = 0.3 - 4.0 * SPEED * 0.04 * np.arange(1, 9)
    assert share_after(BEHIND) < 0.3 < 0.99 < share_after(np.append(BEHIND, caught_up))
    ahead = 0.3 - 4.0 * SPEED * 0.04 * np.arange(50)
    assert share_after(ahead) == 1.0
    # It is not ahead by what it has gained before.
    assert share_after(np.append(ahead, np.full(19, ahead[-1]))) == pytest.approx(share_after(BEHIND), rel=1e-4)


def test_the_share_comes_back_while_contact_is_firm():
    def share(distance: float, is_firm: bool) -> float:
        return Approach(at(0.3), 0.1).updated(at(distance), GOAL, 0.5, 0.5, SPEED, is_firm).share

    assert share(0.3, True) == pytest.approx(0.1 * math.e)
    # No slower than without.
    assert share(0.26, True) == share(0.26, False)


def test_progress_is_towards_the_goal_as_it_is_now():
    """A goal that moves away is no delay, and one that comes no progress."""
    approach = Approach(at(0.3), 0.1)
    for goal in (at(0.02), at(-0.02)):
        assert approach.updated(at(0.3), Target(goal), 0.5, 0.5, SPEED).share == pytest.approx(0.1 / math.e)


def test_an_arm_that_is_where_it_should_be_but_not_as_it_should_is_behind():
    """Contact that holds the flange askew must become cheap, too. A goal that turns away is no delay."""

    def share(before: float, now: float, goal: float = 0.0) -> float:
        turned = lambda angle: rotation_about([0.0, 1.0, 0.0], angle)  # noqa: E731
        approach, target = Approach(ORIGIN, 0.5, turned(before)), Target(ORIGIN, turned(goal))
        return approach.updated(ORIGIN, target, 0.5, 0.5, SPEED, rotation=turned(now)).share

    assert share(0.1, 0.1) == pytest.approx(0.5 / math.e)
    assert share(0.15, 0.1) == pytest.approx(0.5)
    assert share(0.1, 0.03) == 0.5
    assert share(0.1, 0.15, 0.5) == pytest.approx(0.5)
    assert Approach(ORIGIN, 0.5).updated(ORIGIN, GOAL, 0.5, 0.5, SPEED).share == 0.5


def test_contact_becomes_cheap_for_an_arm_that_is_at_its_goal_askew(planner):
    def share(goal: Target) -> float:
        planner.reset()
        for time in range(0, 400, 40):
            planner.plan(Request(HOME, REST, time * MS, time * MS, goal, Spheres.none()))
        return planner.memory.approach.share

    there = RobotModel(ARM).tip_pose(HOME)[1]
    assert share(Target(FLANGE, rotation_about([0.0, 1.0, 0.0], 0.2) @ there)) < 0.7
    assert share(Target(FLANGE, there)) == share(Target(FLANGE)) == 1.0


def test_the_weight_of_contact_falls_for_one_goal_only(planner, monkeypatch):
    """One and the same contact, while the arm is told to be where it was, again and again."""
    monkeypatch.setattr(planner, "_settings", dataclasses.replace(SMALL, contact_patience=0.1))
    spheres = ball_at(FLANGE + 0.14 * DOWN)

    def weight(time: int, goal: Target) -> float:
        plan = planner.plan(Request(HOME, REST, time * MS, time * MS, goal, spheres))
        force = plan.predicted_contact_forces.max(axis=1).sum()
        return plan.cost_terms["contact"] / force if force else math.nan

    goal, other = Target(FLANGE + 0.3 * DOWN), Target(FLANGE + 0.3 * DOWN + 0.05)
    weights = [weight(time, goal) for time in range(0, 800, 40)]
    found = [value for value in weights if not math.isnan(value)]
    assert len(found) > 5
    assert max(found) <= SMALL.contact_weight * 1.001
    assert found[-1] < 0.1 * SMALL.contact_weight
    weight(800, other)
    assert planner.memory.approach.share == 1.0
    weight(840, other)
    assert planner.memory.approach.share < 1.0
    planner.reset()
    weight(880, other)
    assert planner.memory.approach.share == 1.0
