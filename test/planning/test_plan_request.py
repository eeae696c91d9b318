"""What a plan was made for and started from, as bags have it."""

import dataclasses

import jax
import numpy as np
import pytest
from arm_simulation import HOME, REST
from planning_helpers import FLANGE, MS, SMALL, ball_at

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.messages.plan_request import Parts, read_memory, read_request, request_parts
from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.solver.solver import Solution
from contact_reach_ros.world.goal import Target

GOAL = Target(FLANGE + np.array([0.1, 0.2, 0.0]), np.eye(3))
BALL = ball_at(FLANGE + np.array([0.0, 0.14, 0.0]))
RAMP_S = ImpedanceSettings().reference_ramp


def request_at(time: int, goal: Target = GOAL) -> Request:
    return Request(HOME, REST, time * MS, (time + 40) * MS, goal, BALL, speed_scale=0.7)


class Found:
    """Stands in for a solver that finds a known solution."""

    def __init__(self, best):
        self.best = best

    def solve(self, *_):
        return Solution(self.best, 0.0, 1, "max_steps", (0.0,))


def plan_again(planner: RecedingHorizonPlanner, parts: Parts, like: Request) -> Plan:
    request = read_request(parts, like.state_ns, like.effect_ns)._replace(spheres=like.spheres)
    planner.memory = read_memory(parts, request, SMALL.knot_duration, RAMP_S)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "_solver", Found(parts["found"]))
        return planner.plan(request)


def check_same(again: Plan, first: Plan) -> None:
    assert again.cost == pytest.approx(first.cost, rel=1e-5)
    for name, tolerance in (("positions", 1e-6), ("rotations", 1e-5), ("postures", 1e-5), ("predicted_q", 1e-5)):
        np.testing.assert_allclose(getattr(again, name), getattr(first, name), rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("goal", [GOAL, Target(FLANGE)], ids=["the same goal", "another goal"])
@pytest.mark.parametrize("before", [0, 3], ids=["the first plan", "a later one"])
def test_a_plan_is_made_again_from_its_message_alone(planner, before, goal):
    for time in range(before):
        planner.plan(request_at(30 * time))
    memory, request = planner.memory, request_at(90, goal)
    first = planner.plan(request)
    parts = request_parts(first.number, request, memory, planner.memory.best)
    check_same(plan_again(planner, parts, request), first)
    if before:
        again, kept = read_memory(parts, request, SMALL.knot_duration, RAMP_S).approach, memory.approach
        for name in ("position", "share", "rotation"):
            np.testing.assert_array_equal(getattr(again, name), getattr(kept, name))
        # As in bags of 0.2.
        parts_then = parts | {"approach": parts["approach"][:4]}
        then = read_memory(parts_then, request, SMALL.knot_duration, RAMP_S).approach
        assert then.share == kept.share and then.rotation is None
        # What it started from matters.
        alone = plan_again(planner, {name: part for name, part in parts.items() if name != "best"}, request)
        assert alone.cost != pytest.approx(first.cost, rel=1e-3)


def test_a_plan_that_holds_the_orientation_at_a_free_goal_is_made_again(planner):
    planner.reset()
    request = request_at(0, Target(FLANGE))._replace(rest=np.eye(3))
    first = planner.plan(request)
    assert first.cost_terms["orientation"] > 0.0
    parts = request_parts(first.number, request, None, planner.memory.best)
    check_same(plan_again(planner, parts, request), first)


def test_a_plan_that_holds_what_is_in_force_is_made_again(planner):
    planner.plan(request_at(0))
    memory, request = planner.memory, request_at(30)._replace(holds=True)
    first = planner.plan(request)
    assert first.stop_reason == "held"
    check_same(plan_again(planner, request_parts(first.number, request, memory, planner.memory.best), request), first)


def test_a_plan_on_a_detour_is_made_again(planner):
    planner.plan(request_at(0))
    detour = Detour(HOME + 0.1, 0.1, 3, True, np.stack([HOME, HOME + 0.4]), np.stack([HOME + 0.3, HOME + 0.4]))
    memory = planner.memory._replace(request=planner.memory.request._replace(detour=detour))
    planner.memory = memory
    first = planner.plan(request_at(40))
    assert first.cost_terms["detour"] > 0.0
    parts = request_parts(2, request_at(40), memory, planner.memory.best)
    check_same(plan_again(planner, parts, request_at(40)), first)


def test_only_what_can_be_in_force_is_kept(planner):
    """Three plans: the first has been replaced when the state is measured, the last is yet to take effect."""
    for time in (0, 60, 90):
        planner.plan(request_at(time))
    parts = request_parts(4, request_at(120), planner.memory, planner.memory.best)
    read = read_memory(parts, request_at(120), SMALL.knot_duration, RAMP_S)
    assert [each.effect_ns for each in read.trajectories] == [100 * MS, 130 * MS]


def test_the_clock_of_detours_goes_on_where_plans_were_refused(planner):
    planner.plan(request_at(0))
    memory = planner.memory._replace(request=planner.memory.request._replace(effect_ns=100 * MS))
    parts = request_parts(2, request_at(90), memory, planner.memory.best)
    assert read_memory(parts, request_at(90), SMALL.knot_duration, RAMP_S).request.effect_ns == 100 * MS


def test_planning_compiles_nothing_after_the_warm_up_and_for_other_weights(planner, monkeypatch):
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "backend_compile" in event else None
    )
    for time, weight in ((0, 1.0), (30, 1.0), (60, 2.0)):
        monkeypatch.setattr(planner, "_settings", dataclasses.replace(SMALL, goal_weight=weight))
        planner.plan(request_at(time))
    assert not compiled
