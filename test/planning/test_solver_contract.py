"""A solver is one file and an entry in `SOLVERS`: the planner carries, shifts and records whatever its state is."""

import math
from typing import NamedTuple

import jax
import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST
from planning_helpers import PERMITTED_FORCE, SMALL

from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
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
