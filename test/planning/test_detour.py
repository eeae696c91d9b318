"""Detours through another posture at the goal, where the straight way has come to its end."""

import dataclasses
import itertools
import re
from typing import Any

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import MS, ORIGINS, PERMITTED_FORCE, ROTATIONS, SMALL, ball_at

from contact_reach_ros.arm import link_frames
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import PlanningError, UnreachableError
from contact_reach_ros.planning.detour import Detour, Detours
from contact_reach_ros.planning.paths import Statics, duration, durations, length
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.terms import TERMS
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.collision import nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Plane
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

GOAL = Target(ORIGINS[-1] + np.array([0.1, 0.15, -0.1]), ROTATIONS[-1])
PERIOD = 0.04
DETOURS = Detours(ARM, SMALL, PERMITTED_FORCE)
SLALOM = load_scene("slalom")


def followed(last: Request, q: np.ndarray, seconds: float = PERIOD, **changes: Any) -> Request:
    """The last of the requests of some seconds at joint angles `q`; `changes` are of their other fields."""
    for _ in range(round(seconds / PERIOD)):
        request = last._replace(q=q, effect_ns=last.effect_ns + round(PERIOD * 1e9), **changes)
        last = DETOURS.target(request, last)
    return last


def begin(**changes: Any) -> Request:
    return DETOURS.target(Request(HOME, REST, 0, 0, GOAL, Spheres.none())._replace(**changes), None)


def slalom_and_goal() -> tuple[Spheres, Target]:
    return obstacle_spheres(SLALOM, rest_positions(SLALOM)), Target(SLALOM.goal.position)


def statics_of(spheres: Spheres, goal: Target) -> Statics:
    return Statics(SLALOM.arm, spheres, SLALOM.start, goal)


def late(spheres: Spheres, goal: Target) -> Request:
    """In the slalom, after the arm has waited at its start."""
    detours = Detours(SLALOM.arm, SMALL, PERMITTED_FORCE)
    last = detours.target(Request(SLALOM.start, REST, 0, 0, goal, spheres), None)
    last = last._replace(detour=last.detour._replace(waited=SMALL.detour_patience))
    return detours.target(last._replace(effect_ns=last.effect_ns + 40 * MS), last)


def test_without_progress_a_detour_leads_to_another_posture_at_the_goal():
    waiting = followed(begin(), HOME, 0.96)
    assert not waiting.on_detour and waiting.detour.number == 0
    request = followed(waiting, HOME, 0.16)
    assert request.on_detour == 1
    posture = request.detour.posture
    rotations, origins = link_frames(ARM, posture)
    np.testing.assert_allclose(origins[-1], GOAL.position, atol=2e-4)
    assert GOAL.angle(rotations[-1]) < 2e-3
    assert np.abs(posture - HOME).max() > 0.3
    assert (posture > ARM.lower + 0.19).all() and (posture < ARM.upper - 0.19).all()


def test_a_detour_leads_to_a_goal_that_joint_limits_let_the_arm_reach_only_nearly():
    """Each posture that is exactly there is less than 0.01 rad from a limit, and detours keep 0.02 rad."""
    position = np.array([0.2594705, -0.1916530, 0.2253139])
    rotation = np.array(
        [[-0.747798, -0.256046, -0.612567], [0.634889, -0.545654, -0.546971], [-0.1942, -0.797936, 0.5706]]
    )
    seeds = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (256, 7))
    assert len(solve_ik(ARM, position, rotation, seeds, 0.0)) and not len(
        solve_ik(ARM, position, rotation, seeds, 0.02)
    )
    request = followed(begin(goal=Target(position, rotation)), HOME, 1.2)
    assert request.on_detour
    posture = request.detour.path[-1]
    rotations, origins = link_frames(ARM, posture)
    assert np.linalg.norm(origins[-1] - position) < 0.005 and request.goal.angle(rotations[-1]) < 0.025
    assert (posture > ARM.lower + 0.019).all() and (posture < ARM.upper - 0.019).all()


def test_an_arm_that_swings_at_the_edge_of_its_goal_takes_a_detour():
    request = begin(goal=Target(ORIGINS[-1] + np.array([0.0, 0.011, 0.0]), ROTATIONS[-1]))
    inside = HOME + np.array([0.004, 0.0, 0.0, 0.0, 0.0, 0.0, -0.004])
    assert np.linalg.norm(link_frames(ARM, inside)[1][-1] - request.goal.position) < 0.01
    for _ in range(4):
        request = followed(followed(request, HOME, 0.4), inside, 0.08)
    assert request.detour.number == 1


def test_progress_of_a_centimetre_a_second_is_enough_and_less_of_a_slow_arm():
    def searches(speed: float, pace: float) -> int:
        """While the tip moves straight to its goal."""
        away = Target(ORIGINS[-1] + np.array([0.3, 0.0, 0.0]))
        request = begin(goal=away, speed_scale=pace)
        model = RobotModel(ARM)
        model.update(HOME, REST)
        along = np.linalg.pinv(model.jacobian[:3])[:, 0]
        for step in range(1, 60):
            request = followed(request, HOME + speed * step * PERIOD * along)
        return request.detour.number

    assert searches(0.02, 1.0) == 0
    assert searches(0.005, 1.0) > 0
    assert searches(0.005, 0.2) == 0


def test_it_ends_near_its_posture_and_the_next_one_leads_elsewhere():
    first = followed(begin(), HOME, 1.2)
    arrived = followed(first, first.detour.posture + 0.02)
    assert not arrived.on_detour and arrived.detour.number == 1
    stuck = followed(first, HOME, 2.2)
    assert stuck.on_detour == 2
    assert np.abs(stuck.detour.posture - first.detour.posture).max() > 0.3


def test_an_arm_that_has_been_at_the_goal_waits_longer_before_it_leaves_its_posture():
    rests = followed(begin(goal=Target(ORIGINS[-1], ROTATIONS[-1])), HOME, 10.0)
    assert rests.detour.number == 0
    pushed = HOME + np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert followed(rests, pushed, 4.9).detour.number == 0
    assert followed(rests, pushed, 5.2).on_detour == 1
    moving = dataclasses.replace(rests.goal, velocity=np.array([0.0, 0.01, 0.0]))
    held = followed(rests, pushed, 20.0, goal=moving)
    assert held.detour.number == followed(held, pushed, 4.9, goal=rests.goal).detour.number == 0
    coming = followed(rests, pushed, 4.4)
    for share in np.linspace(1.0, 0.2, 50):
        coming = followed(coming, HOME + share * (pushed - HOME))
    assert coming.detour.number == 0


def test_an_arm_on_a_detour_that_moves_on_as_fast_as_counts_is_not_sent_elsewhere():
    request = followed(begin(), HOME, 1.2)
    posture, first = request.detour.posture, request.detour.number
    way = (posture - HOME) / np.linalg.norm(posture - HOME)
    for step in range(1, 200):
        request = followed(request, HOME + 0.055 * step * PERIOD * way)
    assert request.detour.number == first


@pytest.mark.parametrize(("stiffness", "least"), [(85.0, 1.0), (300.0, 3.0)])
def test_an_arm_finds_a_path_away_from_where_it_presses_harder_than_permitted(stiffness, least):
    """As among the nodes of a mesh, each of which is counted as if it were alone."""
    pressed = dataclasses.replace(ball_at(link_frames(ARM, HOME)[1][4], stiffness), radius=np.array([0.1]))
    pressing = float(Statics(ARM, pressed, HOME, GOAL).forces(HOME[None])[0])
    assert pressing > least * PERMITTED_FORCE
    leaving = followed(begin(spheres=pressed), HOME, 1.2, spheres=pressed)
    assert leaving.on_detour == 1
    forces = Statics(ARM, pressed, HOME, GOAL).forces(leaving.detour.path)
    above = forces > PERMITTED_FORCE
    assert forces.max() <= pressing + 0.6
    assert not above[int(above.argmin()) :].any()


def test_no_detour_leads_into_more_force_than_permitted():
    """A goal is refused where every posture there presses harder, and not where only the ways to the nearest do."""
    soft, firm = ball_at(GOAL.position, 20.0), ball_at(GOAL.position, 5000.0)
    assert followed(begin(), HOME, 1.2, spheres=soft).on_detour
    for refused in (lambda: begin(spheres=firm), lambda: followed(begin(), HOME, 1.2, spheres=firm)):
        with pytest.raises(UnreachableError, match=r"contact budget: each of \d{3,} postures at the goal .* N"):
            refused()
    followed(begin(), HOME, 0.96, spheres=firm)


def test_a_path_leads_around_what_is_in_the_straight_ways():
    """Through the slalom of the paper's authors, to which no straight way in joint space leads."""
    spheres, goal = slalom_and_goal()
    detours, q = Detours(SLALOM.arm, SMALL, PERMITTED_FORCE), SLALOM.start
    request = late(spheres, goal)
    path = np.concatenate([q[None], request.detour.path])
    assert request.on_detour == 1 and length(path) > 1.0
    np.testing.assert_allclose(link_frames(SLALOM.arm, path[-1])[1][-1], goal.position, atol=2e-4)
    statics = statics_of(spheres, goal)
    assert statics.reach(q, path[-1], 0.0)[0] < 1.0
    assert all(statics.reach(a, b, 0.0) == (1.0, 0.0) for a, b in itertools.pairwise(path))
    # Plans lead a little ahead, then to the posture at the end.
    on = detours.target(request._replace(q=path[3], effect_ns=request.effect_ns + 40 * MS), request)
    assert len(on.detour.path) < len(request.detour.path) - 2
    assert 0.5 <= np.linalg.norm(on.detour.posture - path[3]) < 1.0
    assert on.on_detour == 1 and on.detour.waited == 0.0


def test_a_path_leads_to_a_goal_where_every_posture_presses_nearly_as_hard_as_permitted():
    slalom, goal = slalom_and_goal()
    # With the orientation at the end of a way, so that the tip is as deep in a ball there in every posture.
    end = late(slalom, goal).detour.path[-1]
    goal, soft = Target(goal.position, link_frames(SLALOM.arm, end)[0][-1]), ball_at(goal.position)

    def among(stiffness: float) -> tuple[Spheres, float]:
        parts = {name: np.concatenate([getattr(slalom, name), getattr(soft, name)]) for name in ("center", "rest")}
        parts |= {name: np.append(getattr(slalom, name), getattr(soft, name)) for name in ("radius", "damping")}
        spheres = dataclasses.replace(slalom, **parts, stiffness=np.append(slalom.stiffness, stiffness))
        return spheres, float(statics_of(spheres, goal).forces(end[None])[0])

    spheres = next(found for found, force in map(among, np.arange(20.0, 400.0)) if force > 0.87 * PERMITTED_FORCE)
    forces = statics_of(spheres, goal).forces(late(spheres, goal).detour.path)
    assert 0.8 * PERMITTED_FORCE < forces[-1] <= PERMITTED_FORCE and len(forces) > 3
    assert forces.max() <= PERMITTED_FORCE


def test_near_the_goal_the_arm_waits_twice_as_long_among_soft_obstacles():
    """Contact becomes cheap meanwhile."""
    beside, down = ball_at(ORIGINS[-1] + np.array([0.5, 0.5, 0.5])), np.array([0.0, 0.0, -1.0])
    near, far = Target(ORIGINS[-1] + 0.03 * down, ROTATIONS[-1]), Target(ORIGINS[-1] + 0.08 * down, ROTATIONS[-1])

    def searches(seconds: float, goal: Target, spheres: Spheres = beside, q: np.ndarray = HOME) -> int:
        return followed(begin(goal=goal, spheres=spheres, q=q), q, seconds).detour.number

    assert (searches(1.92, near), searches(2.2, near)) == (0, 1)
    askew = HOME + 0.4 * np.eye(ARM.n)[-1]
    assert searches(1.2, far) == searches(1.2, near, q=askew) == searches(1.2, near, Spheres.none()) == 1
    # Only then may plans wait for a search.
    waiting = followed(begin(goal=near, spheres=beside), HOME, 1.4)
    assert not DETOURS.may_search(waiting) and DETOURS.may_search(followed(waiting, HOME, 0.4))


def test_the_straight_way_that_is_taken_is_the_quickest():
    """The tip is slow: the longer way in joint space may take less time."""
    shoulder, hand = 1.0 * np.eye(ARM.n)[0], 1.5 * np.eye(ARM.n)[-1]
    swing = float(np.linalg.norm(ORIGINS[-1][:2]))
    found = durations(ARM, HOME, HOME + np.array([shoulder, hand, np.zeros(ARM.n)]))
    np.testing.assert_allclose(found, [swing / 0.12, 1.5 / 0.5, 0.0], rtol=0.01, atol=1e-9)
    assert duration(ARM, HOME + np.array([np.zeros(ARM.n), hand, shoulder + hand])) == pytest.approx(found[:2].sum())
    way = DETOURS._straight(DETOURS._statics(begin()), HOME + np.array([shoulder, hand]))
    np.testing.assert_array_equal(way, [HOME + hand])


def test_contact_costs_less_the_longer_the_arm_waits_on_a_detour():
    first = followed(begin(), HOME, 1.2)
    later = followed(first, HOME, 0.8)
    assert later.on_detour == first.on_detour == 1
    price = lambda request, **changes: request.detour.weights(dataclasses.replace(SMALL, **changes))["contact"]  # noqa: E731
    waited = later.detour.waited - first.detour.waited
    assert price(later) == pytest.approx(price(first) * np.exp(-waited / SMALL.contact_patience))
    at_first = price(first._replace(detour=first.detour._replace(waited=0.0)))
    assert at_first == price(later, contact_patience=0.0) > SMALL.contact_weight


def test_settings_permit_none():
    detours = Detours(ARM, dataclasses.replace(SMALL, detour_patience=0.0), PERMITTED_FORCE)
    request = Request(HOME, REST, 0, 0, GOAL, Spheres.none())
    assert detours.target(request, request) is request


def test_plans_on_a_detour_lead_to_its_posture(planner):
    requests = [Request(HOME, REST, time * MS, (time + 40) * MS, GOAL, Spheres.none()) for time in range(0, 1240, 40)]
    before, *_, on = [planner.plan(request) for request in requests]
    posture = planner.memory.request.detour.posture
    assert before.cost_terms["goal"] > 0.0 == before.cost_terms["detour"]
    assert on.cost_terms["detour"] > 0.0 == on.cost_terms["goal"]
    start, end = (np.linalg.norm(on.predicted_q[knot] - posture) for knot in (0, -1))
    assert end < start - 0.05


def test_the_search_on_a_detour_begins_with_the_straight_way_through_joint_space(planner, monkeypatch):
    space, far = planner._space, HOME + 0.4
    np.testing.assert_allclose(np.abs(space.towards(HOME, far)).max(), 1.0)
    near = HOME + np.array([0.004, -0.005, 0.006, 0.004, -0.003, 0.002, 0.005])
    action = (space.towards(HOME, near) * space.bounds).reshape(SMALL.horizon, -1)[-1]
    np.testing.assert_allclose(action[:3], link_frames(ARM, near)[1][-1] - ORIGINS[-1], atol=1e-4)
    np.testing.assert_allclose(action[6:], near - HOME)
    costs, solve = [], planner._solver.solve

    def look(problem, state, start_cost, *rest):
        still = np.zeros_like(space.bounds)
        costs.append((start_cost, planner._costs(problem, np.stack([still, still], axis=1).astype(np.float32))[0]))
        return solve(problem, state, start_cost, *rest)

    monkeypatch.setattr(planner._solver, "solve", look)
    planner.reset()
    planner.plan(Request(HOME, REST, 0, 40 * MS, GOAL, Spheres.none()))
    detour = Detour(HOME, 0.0, 1, True, far[None], far[None])
    planner.memory = planner.memory._replace(
        trajectories=(planner.memory.trajectories[-1].without_knots(),),
        best=np.zeros_like(planner.memory.best),
        request=planner.memory.request._replace(detour=detour),
    )
    planner.plan(Request(HOME, REST, 30 * MS, 70 * MS, GOAL, Spheres.none()))
    planner.reset()
    started, still = costs[-1]
    assert started < still - 0.01


def test_plans_of_an_arm_without_progress_last_as_long_as_most_searches(planner):
    """Without a plan the controller gives way to contact, and stops where that does not end it."""
    planner.reset()
    plan = planner.plan(Request(HOME, REST, 0, 40 * MS, GOAL, Spheres.none()))
    assert plan.references().ends_ns[-1] == 300 * MS
    last = planner.memory.request
    planner.memory = planner.memory._replace(request=last._replace(detour=last.detour._replace(waited=0.9)))
    plan = planner.plan(Request(HOME, REST, 30 * MS, 70 * MS, GOAL, Spheres.none()))
    assert plan.references().ends_ns[-1] == 1000 * MS
    np.testing.assert_array_equal(plan.positions[3:], [plan.positions[2]] * 7)
    assert len(plan.predicted_q) == 4
    next_plan = planner.plan(Request(HOME, REST, 60 * MS, 100 * MS, GOAL, Spheres.none()))
    np.testing.assert_allclose(next_plan.predicted_q[0], plan.predicted_q[0], atol=0.02)
    planner.reset()


def test_where_every_plan_would_end_in_a_collision_the_arm_makes_no_progress(planner, monkeypatch):
    monkeypatch.setitem(TERMS, "clearance", TERMS["clearance"]._replace(weight=0.0))
    lowest = nearest(ARM, HOME[None], (Plane("floor", (0.0, 0.0, 0.0)),))[0].distance
    free, beneath = ball_at(np.array([0.0, 0.0, -5.0])), Target(ORIGINS[-1] - np.array([0.0, 0.0, 0.3]), ROTATIONS[-1])
    above_floor = dataclasses.replace(free, environment=(Plane("floor", (0.0, 0.0, lowest - 0.001)),))
    planner.reset()
    planner.plan(Request(HOME, REST, 0, 40 * MS, beneath, free))
    for time in range(40, 1240, 40):
        with pytest.raises(PlanningError, match="deep in the floor"):
            planner.plan(Request(HOME, REST, time * MS, (time + 40) * MS, beneath, above_floor))
        assert planner.memory.request.detour.number == (time >= 1000), time
    assert planner.memory.plans == 1
    planner.reset()


def test_time_without_plans_is_no_lack_of_progress():
    last = begin()
    for seconds in (5, 10):
        last = DETOURS.target(last._replace(effect_ns=seconds * 1000 * MS), last)
    assert not last.on_detour and last.detour.waited < 0.7


UR10 = load_arm("ur10")
"""Six joints, of which five turn once to either side, and so have two places for most angles."""

START = np.array(UR10.home)
BOUND = Detours(UR10, SMALL, PERMITTED_FORCE)
REQUESTS = 40
"""As many as the arm needs to give up, and more."""


def pose(q: np.ndarray) -> Target:
    rotations, origins = link_frames(UR10, q)
    return Target(origins[-1], rotations[-1])


ELSEWHERE = pose(START + np.array([0.4, -0.2, 0.3, 0.1, 0.2, 0.3]))


def stuck(spheres: Spheres) -> list[Request]:
    """Requests of the arm with six joints, which stays at its start, until it gives up."""
    requests = [BOUND.target(Request(START, REST[:6], 0, 0, ELSEWHERE, spheres), None)]
    try:
        while len(requests) < REQUESTS:
            last = requests[-1]
            requests.append(BOUND.target(last._replace(effect_ns=last.effect_ns + 300 * MS), last))
    except UnreachableError as error:
        assert re.search(f"is left to try after {len(last.detour.postures) - 1}:", str(error))
    return requests


def side(q: np.ndarray) -> float:
    """Of the singularities on which the arm is: the sign of the determinant of its Jacobian."""
    model = RobotModel(UR10)
    model.update(q, REST[:6])
    return float(np.sign(np.linalg.det(model.jacobian)))


def test_without_free_dimensions_an_arm_goes_for_its_goal_after_each_detour_and_gives_up_when_none_is_left():
    requests = stuck(Spheres.none())
    posture, *others = requests[-1].detour.postures[1:]
    np.testing.assert_allclose(posture, START + np.array([0.4, -0.2, 0.3, 0.1, 0.2, 0.3]), atol=5e-3)
    for turned in (posture - 2.0 * np.pi, posture + 2.0 * np.pi):
        is_within = (turned > UR10.lower + 0.2) & (turned < UR10.upper - 0.2)
        assert (np.abs(turned - START) >= np.abs(posture - START))[is_within].all()
    # The others are behind a straight way past a singularity, which a path goes around.
    for one, other in itertools.combinations([posture, *others], 2):
        assert np.abs((one - other + np.pi) % (2.0 * np.pi) - np.pi).max() > 0.3
    assert [on > 0 for on, _ in itertools.groupby(request.on_detour for request in requests)] == [
        False,
        *[True, False] * (1 + len(others)),
    ]


@pytest.mark.slow
def test_without_free_dimensions_no_detour_passes_a_singularity():
    seeds = np.random.default_rng(0).uniform(UR10.lower, UR10.upper, (64, 6))
    found = solve_ik(UR10, ELSEWHERE.position, ELSEWHERE.rotation, seeds, 0.2)
    assert {side(posture) for posture in found} == {-1.0, 1.0}
    tried = stuck(Spheres.none())[-1].detour.postures[1:]
    assert {side(posture) for posture in tried} == {side(START)}


@pytest.mark.slow
def test_among_soft_obstacles_which_may_go_away_no_goal_is_given_up():
    assert len(stuck(ball_at(np.array([0.0, 0.0, -5.0])))) == REQUESTS
