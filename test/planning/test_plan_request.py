"""What a plan was made for and started from, as bags have it."""

import dataclasses

import jax
import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import PERMITTED_FORCE, SMALL
from test_receding_horizon import FLANGE, MS, ball_at
from test_solver_contract import RandomWalk

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.messages.plan_request import Parts, read_memory, read_request, request_parts
from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.solver import SOLVERS, make_solver
from contact_reach_ros.world.goal import Target

GOAL = Target(FLANGE + np.array([0.1, 0.2, 0.0]), np.eye(3))
BALL = ball_at(FLANGE + np.array([0.0, 0.14, 0.0]))
RAMP_S = ImpedanceSettings().reference_ramp


def request_at(time: int, goal: Target = GOAL) -> Request:
    return Request(HOME, REST, time * MS, (time + 40) * MS, goal, BALL, speed_scale=0.7)


def plan_again(planner: RecedingHorizonPlanner, parts: Parts, like: Request) -> Plan:
    request = read_request(parts, (like.state_ns, like.effect_ns))._replace(spheres=like.spheres)
    planner.memory = read_memory(parts, request, planner.fresh_state, SMALL.knot_duration, RAMP_S)
    return planner.plan(request)


def check_same(again: Plan, first: Plan) -> None:
    assert again.cost == pytest.approx(first.cost, rel=1e-4)
    for name, tolerance in (("positions", 1e-4), ("rotations", 1e-3), ("postures", 1e-3), ("predicted_q", 1e-4)):
        np.testing.assert_allclose(getattr(again, name), getattr(first, name), rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("goal", [GOAL, Target(FLANGE)], ids=["the same goal", "another goal"])
def test_a_plan_is_made_again_from_its_message_alone(planner, goal):
    for time in range(0, 90, 30):
        planner.plan(request_at(time))
    memory, request = planner.memory, request_at(90, goal)
    first = planner.plan(request)
    parts = request_parts(first.number, request, memory)
    planner.plan(request_at(120))
    check_same(plan_again(planner, parts, request), first)
    # What it started from matters.
    planner.reset()
    assert planner.plan(request).cost != pytest.approx(first.cost, rel=1e-3)


def test_the_first_plan_after_a_reset_starts_from_nothing(planner):
    first = planner.plan(request_at(0))
    parts = request_parts(first.number, request_at(0), None)
    planner.plan(request_at(30))
    assert read_memory(parts, request_at(0), planner.fresh_state, SMALL.knot_duration, RAMP_S) is None
    check_same(plan_again(planner, parts, request_at(0)), first)


def test_a_plan_on_a_detour_is_made_again(planner):
    planner.plan(request_at(0))
    detour = Detour(2.0, 0.1, 3, True, False, HOME + 0.4)
    memory = planner.memory._replace(detour=detour)
    planner.memory = memory
    first = planner.plan(request_at(40))
    assert first.cost_terms["detour"] > 0.0
    check_same(plan_again(planner, request_parts(2, request_at(40), memory), request_at(40)), first)


def test_references_that_step_have_none_before():
    gains = dataclasses.replace(ImpedanceSettings(), reference_ramp=0.0)
    planner = RecedingHorizonPlanner(ARM, dataclasses.replace(SMALL, max_steps=1), gains, PERMITTED_FORCE, 0)
    planner.plan(request_at(0))
    memory = planner.memory
    parts = request_parts(2, request_at(30), memory)
    read = read_memory(parts, request_at(30), planner.fresh_state, SMALL.knot_duration, 0.0)
    (trajectory,), (expected,) = read.trajectories, memory.trajectories
    assert trajectory.before is None and trajectory.effect_ns == expected.effect_ns
    np.testing.assert_allclose(trajectory.positions, expected.positions, rtol=0, atol=1e-6)


def test_only_what_can_be_in_force_is_kept(planner):
    """Three plans: the first has been replaced when the state is measured, the last is yet to take effect."""
    for time in (0, 60, 90):
        planner.plan(request_at(time))
    parts = request_parts(4, request_at(120), planner.memory)
    read = read_memory(parts, request_at(120), planner.fresh_state, SMALL.knot_duration, RAMP_S)
    assert [each.effect_ns for each in read.trajectories] == [100 * MS, 130 * MS]


@pytest.mark.parametrize("name", SOLVERS)
def test_states_of_all_solvers_are_kept_whole(name, planner):
    planner.plan(request_at(0))
    solver = make_solver(lambda problem, points: points[0], 39, dataclasses.replace(SMALL, solver=name))
    state = solver.init(np.linspace(-1.0, 1.0, 39), np.linspace(0.1, 1.0, 39))
    parts = request_parts(2, request_at(30), planner.memory._replace(state=state))
    read = read_memory(parts, request_at(30), solver.init(np.zeros(39), np.ones(39)), SMALL.knot_duration, RAMP_S)
    for found, expected in zip(read.state, state, strict=True):
        np.testing.assert_array_equal(found, np.asarray(expected))
        assert found.dtype == expected.dtype


def test_another_kind_of_solver_is_noticed(planner):
    planner.plan(request_at(0))
    parts = request_parts(2, request_at(30), planner.memory)
    like = RandomWalk(lambda problem, points: points[0], 39, SMALL).init(np.zeros(39), np.ones(39))
    with pytest.raises((KeyError, ValueError)):
        read_memory(parts, request_at(30), like, SMALL.knot_duration, RAMP_S)


def test_a_message_is_small(planner):
    """At 33 plans a second they are less than half of what the joint states are."""
    for time in range(0, 120, 30):
        planner.plan(request_at(time))
    parts = request_parts(5, request_at(120), planner.memory)
    assert sum(part.nbytes for part in parts.values()) < 6000


def test_planning_compiles_nothing_after_the_warm_up(planner):
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    for time in range(0, 120, 30):
        planner.plan(request_at(time))
    assert not compiled
