"""A planner that plans again and again."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import FLANGE, MS, PERMITTED_FORCE, SMALL, ball_at, beside_forearm

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.prediction import hold_at
from contact_reach_ros.planning.settings import POSTURE_BOUND
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

GOAL = Target(FLANGE + np.array([0.1, 0.15, -0.1]))


def plan_from(planner, q=HOME, v=REST, state=0, effect=0, goal=GOAL, spheres=None) -> Plan:
    """Times in ms."""
    return planner.plan(Request(q, v, state * MS, effect * MS, goal, Spheres.none() if spheres is None else spheres))


def test_plan_moves_towards_the_goal_within_the_bounds(planner):
    plan = plan_from(planner)
    distances = np.linalg.norm(plan.predicted_positions - GOAL.position, axis=1)
    assert (np.diff(distances) < 0.0).all()
    np.testing.assert_allclose(plan.predicted_q[0], HOME, rtol=0, atol=1e-6)
    moves = np.abs(plan.positions - plan.predicted_positions[:-1])
    assert moves[0].max() <= SMALL.translation_bound + 1e-6
    # From where the moving arm is half a ramp later.
    gains = ImpedanceSettings()
    ahead = 0.5 * gains.reference_ramp * gains.task_stiffness / gains.task_damping
    assert SMALL.translation_bound < moves[1:].max() <= (1.0 + ahead) * SMALL.translation_bound
    assert np.abs(plan.postures - plan.predicted_q[:-1]).max() <= POSTURE_BOUND + 1e-6
    np.testing.assert_allclose(
        plan.rotations @ plan.rotations.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-5
    )


def test_ball_in_the_way_is_pushed_with_less_than_the_permitted_force(planner):
    q, v, spheres = HOME, REST, ball_at(beside_forearm(0.01))
    goal = Target(FLANGE + np.array([0.0, 0.25, 0.0]))
    for number in range(10):
        plan = plan_from(planner, q, v, 100 * number, 100 * number, goal, spheres)
        assert plan.predicted_contact_forces.max() <= PERMITTED_FORCE + 0.5
        q, v = plan.predicted_q[1], (plan.predicted_q[2] - plan.predicted_q[1]) / 0.1
    assert np.linalg.norm(plan.predicted_positions[1] - goal.position) < 0.2


def test_a_tip_that_rests_at_its_goal_keeps_what_is_in_force(planner):
    first = plan_from(planner)
    plan = planner.plan(Request(HOME, REST, 30 * MS, 70 * MS, GOAL, Spheres.none(), holds=True))
    assert (plan.stop_reason, plan.steps) == ("held", 0)
    for knots, held in zip((plan.positions, plan.rotations, plan.postures), first.in_force(70 * MS), strict=True):
        np.testing.assert_array_equal(knots, np.broadcast_to(held, knots.shape))


def test_one_that_presses_too_hard_does_not(planner):
    plan_from(planner)
    spheres = ball_at(beside_forearm(-0.02), stiffness=1e4)
    plan = planner.plan(Request(HOME, REST, 30 * MS, 70 * MS, GOAL, spheres, holds=True))
    assert plan.stop_reason != "held" and plan.steps > 0


def test_same_calls_after_a_reset_give_the_same_plans_bit_for_bit(planner):
    def sequence() -> list[Plan]:
        planner.reset()
        first = plan_from(planner)
        return [first, plan_from(planner, first.predicted_q[1], REST, 100, 140)]

    for a, b in zip(sequence(), sequence(), strict=True):
        for name in ("positions", "rotations", "postures", "predicted_q", "predicted_contact_forces"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert a.cost_terms == b.cost_terms
        assert (a.steps, a.stop_reason) == (b.steps, b.stop_reason)
        assert a.number < b.number


def test_a_seed_decides_the_candidates_and_begins_afresh(planner):
    plans = []
    for seed in (7, 8, 7):
        planner.reseed(seed)
        plans.append(plan_from(planner))
    planner.reseed(0)
    np.testing.assert_array_equal(plans[0].postures, plans[2].postures)
    assert not np.array_equal(plans[0].postures, plans[1].postures)
    np.testing.assert_allclose(plans[0].positions, plans[1].positions, atol=3e-3)


def test_plan_starts_from_the_state_predicted_under_the_plan_in_force(planner):
    first = plan_from(planner)
    second = plan_from(planner, HOME, REST, 0, 100)
    # The prediction has a step more than the plan's first knot: it is cut where the reference ceases to move.
    np.testing.assert_allclose(second.predicted_q[0], first.predicted_q[1], rtol=0, atol=2e-4)
    planner.reset()
    third = plan_from(planner, HOME, REST, 0, 100)
    np.testing.assert_allclose(third.predicted_q[0], HOME, rtol=0, atol=1e-5)


def test_jump_of_the_arm_and_time_running_backwards_forget_the_plans(planner):
    plan_from(planner, state=1000, effect=1000)
    elsewhere = HOME + 0.5
    plan = plan_from(planner, elsewhere, REST, 1100, 1200)
    # Held where it is, not dragged along by the plan made for another pose.
    np.testing.assert_allclose(plan.predicted_q[0], elsewhere, rtol=0, atol=1e-4)
    plan = plan_from(planner, elsewhere, REST, 0, 100)
    np.testing.assert_allclose(plan.predicted_q[0], elsewhere, rtol=0, atol=1e-4)


@pytest.mark.parametrize("effect", [0, 85], ids=["in force", "not yet"])
def test_a_plan_whose_x_d_is_too_far_to_be_followed_is_expected_to_be_dropped(planner, effect):
    gone = HOME + np.eye(7)[0] * 0.13
    plan = plan_from(planner, state=0, effect=effect)
    distance = np.linalg.norm(plan.positions[0] - hold_at(ARM, gone).position)
    assert 0.055 < distance < 0.1
    dropped = plan_from(planner, gone, REST, 80, 120)
    np.testing.assert_allclose(dropped.predicted_q[0], gone, rtol=0, atol=1e-6)
    np.testing.assert_allclose(dropped.before.position, hold_at(ARM, gone).position, rtol=0, atol=1e-6)
    planner.reset()
    # The arm may be on its way to it.
    near = HOME + np.eye(7)[0] * 0.06
    plan = plan_from(planner, state=0, effect=effect)
    assert 0.02 < np.linalg.norm(plan.positions[0] - hold_at(ARM, near).position) < 0.05
    followed = plan_from(planner, near, REST, 80, 120)
    assert np.abs(followed.predicted_q[0] - near).max() > 1e-4
    np.testing.assert_allclose(followed.before.position, plan.in_force(120 * MS).position, rtol=0, atol=1e-6)


def test_deadline_too_short_for_one_step_is_refused_and_ends_a_search_after_one(planner, monkeypatch):
    monkeypatch.setattr(planner, "_settings", dataclasses.replace(SMALL, deadline=1e-6))
    with pytest.raises(SettingsError, match=r"planning.deadline = 1e-06 s: one solver step takes \d+\.\d+ s here"):
        planner.warm_up(lambda line: None)
    plan = plan_from(planner)
    assert (plan.stop_reason, plan.steps) == ("deadline", 1)
    assert np.isfinite(plan.cost)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q": np.zeros(6)}, "q = .*expected 7 finite numbers"),
        ({"v": np.full(7, np.nan)}, "v = .*expected 7 finite numbers"),
        ({"state": 10, "effect": 9}, "effect_ns - state_ns = -1000000: expected 0 to"),
        ({"state": 0, "effect": 5000}, "plan from a newer state"),
    ],
)
def test_input_that_makes_no_sense_is_refused(planner, arguments, message):
    with pytest.raises(InputError, match=message):
        plan_from(planner, **arguments)
