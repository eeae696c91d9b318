"""Algorithm 1 on objectives whose minimum is known."""

import dataclasses
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contact_reach_ros.planning.settings import SAMPLINGS, PlanningSettings
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import Solution

N = 6
CENTER = np.zeros(N)
MINIMUM = np.linspace(-0.8, 0.8, N)
SETTINGS = PlanningSettings(deadline=0.0, population=40, max_steps=300)


def quadratic(target: jax.Array, points: jax.Array) -> jax.Array:
    """Convex, smallest at `target`, where it is negative: the logarithm in the paper's line 9 cannot take that."""
    scale = jnp.logspace(0, 1, N)[:, None]
    return (scale * (points - target[:, None]) ** 2).sum(axis=0) - 5.0


def half_undefined(target: jax.Array, points: jax.Array) -> jax.Array:
    return jnp.where(points[0] > 0.0, jnp.nan, quadratic(target, points))


def solve(cost=quadratic, target=MINIMUM, start=CENTER, number=1, until=math.inf, **changes) -> Solution:
    """With a wide spread about `start`."""
    target = jnp.asarray(target, jnp.float32)
    start_cost = float(cost(target, jnp.asarray(start)[:, None])[0])
    start_cost = start_cost if math.isfinite(start_cost) else math.inf
    searching = HybridSolver(cost, np.full(N, 0.3), dataclasses.replace(SETTINGS, **changes))
    searching.stagnation_steps = 30
    return searching.solve(target, np.asarray(start), start_cost, number, until)


def test_it_finds_the_minimum_of_a_convex_function():
    solution = solve()
    np.testing.assert_allclose(solution.best, MINIMUM, rtol=0, atol=0.03)
    assert solution.cost == pytest.approx(-5.0, abs=0.01)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_solution_stays_within_the_bounds(sampling):
    solution = solve(target=np.full(N, 3.0), sampling=sampling)
    assert np.abs(solution.best).max() <= 1.0
    np.testing.assert_allclose(solution.best, 1.0, rtol=0, atol=1e-3)


def test_non_finite_candidates_never_win():
    target = np.full(N, -0.3)
    target[0] = 0.5  # where the function would be smallest, it is not defined
    solution = solve(cost=half_undefined, target=target)
    assert solution.best[0] <= 0.0
    assert math.isfinite(solution.cost)
    np.testing.assert_allclose(solution.best[1:], -0.3, rtol=0, atol=0.1)


def test_a_deadline_that_has_passed_leaves_one_step_and_the_limit_of_steps_ends_the_search():
    limited = solve(max_steps=2)
    assert (limited.stop_reason, limited.steps) == ("max_steps", 2)
    solution = solve(until=time.perf_counter() - 1.0)
    assert (solution.stop_reason, solution.steps) == ("deadline", 1)
    assert solution.cost < solution.costs[0]
    best = jnp.asarray(solution.best)[:, None]
    assert solution.cost == pytest.approx(float(quadratic(jnp.asarray(MINIMUM), best)[0]), rel=1e-6)
