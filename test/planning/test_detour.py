"""Detours through another posture at the goal, where the straight way has come to its end."""

import dataclasses

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import PERMITTED_FORCE, SMALL, make_planner

from benchmarks.clutter_scenes import clutter_name, clutter_scene
from benchmarks.grid import Cell, EpisodeTask, Setup, run_cell
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.detour import Detour, begin, follow
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import MAX_SPHERES, Spheres

ROTATIONS, ORIGINS = link_frames(ARM, HOME)
GOAL = Target(ORIGINS[-1] + np.array([0.1, 0.15, -0.1]), ROTATIONS[-1])
PERIOD = 0.04


def ball_at(center: np.ndarray, stiffness: float) -> Spheres:
    return Spheres(center[None], center[None], np.array([0.1]), np.array([stiffness]), np.array([30.0]))


def followed(detour, q, seconds=PERIOD, goal=GOAL, spheres=None, pace=1.0, **changes):
    settings = dataclasses.replace(SMALL, **changes)
    for _ in range(round(seconds / PERIOD)):
        around = Spheres.none() if spheres is None else spheres
        detour = follow(detour, ARM, q, goal, around, PERIOD, settings, PERMITTED_FORCE, pace)
    return detour


def test_without_progress_a_detour_leads_to_another_posture_at_the_goal():
    waiting = followed(begin(HOME), HOME, 0.96)
    assert not waiting.is_on and waiting.number == 0
    detour = followed(waiting, HOME, 0.16)
    assert detour.is_on and detour.number == 1
    rotations, origins = link_frames(ARM, detour.posture)
    np.testing.assert_allclose(origins[-1], GOAL.position, atol=2e-4)
    assert GOAL.angle(rotations[-1]) < 2e-3
    assert np.abs(detour.posture - HOME).max() > 0.3
    assert (detour.posture > ARM.lower + 0.19).all() and (detour.posture < ARM.upper - 0.19).all()


def test_progress_of_a_centimetre_a_second_is_enough_and_less_of_a_slow_arm():
    def after(speed: float, pace: float) -> Detour:
        detour = begin(HOME)
        for step in range(100):
            # The goal comes nearer instead of the arm.
            place = ORIGINS[-1] + np.array([0.2 - speed * step * PERIOD, 0.0, 0.0])
            goal = Target(place, ROTATIONS[-1])
            detour = followed(detour, HOME, goal=goal, pace=pace)
        return detour

    assert after(0.02, 1.0).number == 0
    assert after(0.005, 1.0).number > 0
    assert after(0.005, 0.2).number == 0


def test_it_ends_near_its_posture_and_the_next_one_leads_elsewhere():
    first = followed(begin(HOME), HOME, 1.2)
    arrived = followed(first, first.posture + 0.02)
    assert not arrived.is_on and arrived.number == 1
    stuck = followed(first, HOME, 1.2)
    assert stuck.is_on and stuck.number == 2
    assert np.abs(stuck.posture - first.posture).max() > 0.3


def test_an_arm_that_has_been_at_the_goal_stays_in_its_posture():
    there = Target(ORIGINS[-1], ROTATIONS[-1])
    rests = followed(begin(HOME), HOME, 4.0, there)
    assert rests.number == 0
    pushed = HOME + np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert followed(rests, pushed, 4.0, there).number == 0


def test_a_detour_that_begins_close_to_the_goal_goes_on():
    close = Target(ORIGINS[-1] + np.array([0.02, 0.0, 0.0]), ROTATIONS[-1])
    detour = followed(begin(HOME), HOME, 1.2, close)
    assert detour.is_on
    assert followed(detour, HOME, 0.4, close).is_on


def test_no_detour_leads_into_more_force_than_permitted():
    soft, firm = ball_at(GOAL.position, 20.0), ball_at(GOAL.position, 5000.0)
    assert followed(begin(HOME), HOME, 1.2, spheres=soft).is_on
    refused = followed(begin(HOME), HOME, 1.2, spheres=firm)
    assert not refused.is_on and refused.number == 1


@pytest.fixture(scope="module")
def stuck():
    """A planner whose arm does not move, with the last plans before and on a detour."""
    planner = make_planner()
    plans = [
        planner.plan(Request(HOME, REST, step * 40_000_000, (step + 1) * 40_000_000, GOAL, Spheres.none()))
        for step in range(31)
    ]
    return planner, plans


def test_plans_on_a_detour_lead_to_its_posture(stuck):
    planner, plans = stuck
    posture = planner.memory.detour.posture
    before, on = plans[10], plans[-1]
    assert before.cost_terms["goal"] > 0.0 == before.cost_terms["detour"]
    assert on.cost_terms["detour"] > 0.0 == on.cost_terms["goal"]
    start, end = (np.linalg.norm(on.predicted_q[knot] - posture) for knot in (0, -1))
    assert end < start - 0.05


def test_time_without_plans_is_no_lack_of_progress():
    planner = make_planner(max_steps=1)
    for seconds in (0, 5, 10):
        start = seconds * 1_000_000_000
        planner.plan(Request(HOME, REST, start, start + 40_000_000, GOAL, Spheres.none()))
    assert not planner.memory.detour.is_on and planner.memory.detour.waited < 0.7


@pytest.mark.parametrize("way", ["setting", "weight", "law (6)", "retreat"])
def test_there_is_none_where_it_is_not_wanted(way):
    changes = {
        "setting": {"detour_patience": 0.0},
        "weight": {"detour_weight": 0.0},
        "law (6)": {"null_space": "reference_posture"},
        "retreat": {},
    }
    planner = make_planner(max_steps=1, **changes[way])
    for step in range(31):
        start, end = step * 40_000_000, (step + 1) * 40_000_000
        plan = planner.plan(Request(HOME, REST, start, end, GOAL, Spheres.none(), detours=way != "retreat"))
        assert plan.cost_terms.get("detour", 0.0) == 0.0


@pytest.mark.slow
def test_detours_reach_a_goal_in_clutter_that_the_straight_way_does_not():
    scene = clutter_scene(ARM, 3)

    def reaches(patience: float) -> bool:
        setup = Setup.of("shipped", load_budget(), capacity=MAX_SPHERES, timeout=60.0)
        setup = dataclasses.replace(setup, planning=dataclasses.replace(setup.planning, detour_patience=patience))
        cell = Cell(clutter_name(3), "hold", "contact_reach", 3)
        return run_cell(EpisodeTask(cell, scene, setup.latency(cell.method), setup))["reached"]

    assert reaches(1.0) and not reaches(0.0)
