"""A solver is one file and an entry in `SOLVERS`: the planner carries, shifts and records whatever its state is."""

import dataclasses
import math
from typing import NamedTuple

import jax
import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import PERMITTED_FORCE, SMALL

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.plan_record import is_keyframe, solution_parts, state_in
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver import SOLVERS, make_solver
from contact_reach_ros.planning.solver.solver import Solution
from contact_reach_ros.planning.warm_start import shift_solution
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

MS = 1_000_000
GOAL = Target(link_frames(ARM, HOME)[1][-1] + np.array([0.1, 0.15, -0.1]))


class Walk(NamedTuple):
    center: np.ndarray
    width: np.ndarray
    searches: np.ndarray


class RandomWalk:
    """Keeps the best of random points, nothing more."""

    def __init__(self, cost, n: int, settings: PlanningSettings) -> None:
        self._cost, self._settings, self._seed = jax.jit(cost), settings, settings.seed
        self.max_steps = 5

    def reseed(self, seed):
        self._seed = seed

    def init(self, mean, spread):
        return Walk(np.float32(mean), np.float32(spread), np.int32(0))

    def shift(self, state, mean, spread, knots, elapsed):
        width = shift_solution(state.width, knots, elapsed)
        return Walk(np.float32(mean), np.float32(width), state.searches)

    def solve(self, problem, state, start_cost, number, until=math.inf):
        random = np.random.default_rng((self._seed, number))
        best, costs = state.center, [start_cost]
        for _ in range(self.max_steps):
            points = best[:, None] + state.width[:, None] * random.standard_normal((len(best), 50))
            points = np.clip(points, -1.0, 1.0).astype(np.float32)
            found = np.asarray(self._cost(problem, points))
            if found.min() < costs[-1]:
                best = points[:, found.argmin()]
            costs.append(min(costs[-1], float(found.min())))
        state = Walk(best, 0.9 * state.width, state.searches + 1)
        return Solution(best, costs[-1], state, self.max_steps, "max_steps", 0, tuple(costs))

    def warm_up(self, problem, state):
        self.solve(problem, state, 0.0, 0)
        return 0.0


def plan_at(planner: RecedingHorizonPlanner, time: int):
    return planner.plan(Request(HOME, REST, time * MS, (time + 40) * MS, GOAL, Spheres.none()))


@pytest.fixture(scope="module")
def planner() -> RecedingHorizonPlanner:
    return RecedingHorizonPlanner(ARM, SMALL, ImpedanceSettings(), PERMITTED_FORCE, 0, solver=RandomWalk)


def test_planner_plans_with_any_solver(planner):
    planner.reset()
    plans = [plan_at(planner, time) for time in range(0, 120, 40)]
    costs = [plan.cost for plan in plans]
    assert costs[-1] < costs[0]
    assert planner.memory.state.searches == 3
    distances = np.linalg.norm(plans[-1].predicted_positions - GOAL.position, axis=1)
    assert distances[-1] < distances[0]


def test_any_state_is_recorded_by_its_fields_and_planned_from_again(planner):
    planner.reset()
    for time in range(0, 80, 40):
        plan_at(planner, time)
    history = planner.history()
    first = plan_at(planner, 80)
    parts = solution_parts(dataclasses.replace(history.memory.plan, number=1), history.memory)
    assert is_keyframe(parts) and set(Walk._fields) <= set(parts)
    state = state_in({name: part.ravel() for name, part in parts.items()}, planner.fresh_state)
    assert isinstance(state, Walk) and state.searches.dtype == np.int32
    planner.go_on_from(history._replace(memory=history.memory._replace(state=state)))
    again = plan_at(planner, 80)
    np.testing.assert_array_equal(again.positions, first.positions)
    assert again.cost == first.cost


def test_state_of_another_solver_is_dropped_and_the_plan_is_kept(planner):
    planner.reset()
    plan_at(planner, 0)
    history = planner.history()
    foreign = make_solver(lambda problem, points: points[0], 39, SMALL).init(np.zeros(39), np.ones(39))
    planner.go_on_from(history._replace(memory=history.memory._replace(state=foreign)))
    assert isinstance(planner.memory.state, Walk)
    np.testing.assert_array_equal(planner.memory.state.center, history.memory.best)
    assert plan_at(planner, 40).cost < np.inf


@pytest.mark.parametrize("name", SOLVERS)
def test_states_of_all_solvers_can_be_told_from_the_rest_of_a_record(name, planner):
    planner.reset()
    plan = plan_at(planner, 0)
    solver = make_solver(lambda problem, points: points[0], 39, dataclasses.replace(SMALL, solver=name))
    state = solver.init(np.zeros(39), np.ones(39))
    memory = planner.memory._replace(state=state)
    without = solution_parts(dataclasses.replace(plan, number=2), memory)
    parts = solution_parts(dataclasses.replace(plan, number=1), memory)
    assert len(parts) == len(without) + len(state._fields)
    for found, expected in zip(state_in(parts, state), state, strict=True):
        np.testing.assert_array_equal(found, expected)
