"""Algorithm 1 on objectives whose minimum is known."""

import dataclasses
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contact_reach_ros.planning.settings import SOLVER_METHODS, PlanningSettings
from contact_reach_ros.planning.solver.cma_es import fresh
from contact_reach_ros.planning.solver.hybrid import HybridSolver, Solution, gradient

N = 12
SETTINGS = PlanningSettings(deadline=0.0, population=40, elite=10, line_search_points=40, stagnation_tolerance=1e-6)


def quadratic(target: jax.Array, points: jax.Array) -> jax.Array:
    """Convex, worst conditioned 1 to 100, smallest at `target`; negative there, which the paper's line 9 cannot take."""
    scale = jnp.logspace(0, 2, N)[:, None]
    return (scale * (points - target[:, None]) ** 2).sum(axis=0) - 5.0


def solve(cost=quadratic, target=None, number=1, until=math.inf, start_cost=None, **changes) -> Solution:
    settings = dataclasses.replace(SETTINGS, **changes)
    target = jnp.asarray(np.linspace(-0.8, 0.8, N) if target is None else target, jnp.float32)
    start = fresh(jnp.zeros(N), jnp.full(N, 0.3))
    if start_cost is None:
        start_cost = float(cost(target, jnp.zeros((N, 1)))[0])
    return HybridSolver(cost, N, settings).solve(target, start, start_cost, number, until)


@pytest.mark.parametrize("method", SOLVER_METHODS)
def test_every_method_finds_the_minimum_of_a_convex_function(method):
    solution = solve(solver=method)
    np.testing.assert_allclose(solution.best, np.linspace(-0.8, 0.8, N), rtol=0, atol=0.03)
    assert solution.cost == pytest.approx(-5.0, abs=0.01)


def test_gradient_steps_save_solver_steps():
    steps = {method: len([cost for cost in solve(solver=method).costs if cost > -4.0]) for method in SOLVER_METHODS}
    assert steps["gradient"] < steps["hybrid"] < steps["cma"]


@pytest.mark.parametrize("penalty", ["quadratic", "paper"])
def test_solution_stays_within_the_bounds(penalty):
    solution = solve(target=np.full(N, 3.0), boundary_penalty=penalty)
    assert np.abs(solution.best).max() <= 1.0
    np.testing.assert_allclose(solution.best, 1.0, rtol=0, atol=1e-3)


def test_same_input_gives_the_same_solution_bit_for_bit():
    first, second = solve(), solve()
    np.testing.assert_array_equal(first.best, second.best)
    assert first.costs == second.costs
    for a, b in zip(first.distribution, second.distribution, strict=True):
        np.testing.assert_array_equal(a, b)


def test_plan_number_and_seed_change_the_random_numbers():
    reference = solve(max_steps=1).best
    assert not np.array_equal(reference, solve(max_steps=1, number=2).best)
    assert not np.array_equal(reference, solve(max_steps=1, seed=1).best)


def test_cost_never_rises():
    costs = np.array(solve().costs)
    assert (np.diff(costs) <= 0.0).all()


def test_non_finite_candidates_are_counted_and_never_win():
    def half_undefined(target: jax.Array, points: jax.Array) -> jax.Array:
        return jnp.where(points[0] > 0.0, jnp.nan, quadratic(target, points))

    target = np.full(N, -0.3)
    target[0] = 0.5  # where the function would be smallest, it is not defined
    solution = solve(cost=half_undefined, target=target)
    assert solution.rejected > 0
    assert solution.best[0] <= 0.0
    assert math.isfinite(solution.cost)
    np.testing.assert_allclose(solution.best[1:], -0.3, rtol=0, atol=0.05)
    assert all(np.isfinite(part).all() for part in solution.distribution)


def test_objective_that_is_nowhere_finite_ends_at_the_start():
    solution = solve(cost=lambda target, points: jnp.full(points.shape[1], jnp.nan), start_cost=math.inf)
    np.testing.assert_array_equal(solution.best, 0.0)
    assert solution.cost == math.inf
    assert solution.stop_reason == "stagnated"
    assert all(np.isfinite(part).all() for part in solution.distribution)


def test_stagnation_and_step_limit_end_the_search():
    solution = solve(stagnation_steps=3)
    assert solution.stop_reason == "stagnated"
    assert solution.costs[-4] - solution.costs[-1] < 3 * SETTINGS.stagnation_tolerance
    solution = solve(max_steps=2)
    assert (solution.stop_reason, solution.steps) == ("max_steps", 2)


def test_deadline_returns_the_best_so_far():
    solution = solve(until=time.perf_counter() - 1.0)
    assert (solution.stop_reason, solution.steps) == ("deadline", 0)
    np.testing.assert_array_equal(solution.best, 0.0)
    now = time.perf_counter()
    # The first step compiles and so outlasts the deadline.
    solution = solve(until=now + 0.05)
    assert (solution.stop_reason, solution.steps) == ("deadline", 1)
    assert solution.cost < solution.costs[0]


def test_solution_is_never_worse_than_its_start():
    minimum = np.linspace(-0.8, 0.8, N)
    settings = dataclasses.replace(SETTINGS, solver="cma", max_steps=3)
    start = fresh(jnp.asarray(minimum, jnp.float32), jnp.full(N, 0.3))
    target = jnp.asarray(minimum, jnp.float32)
    solution = HybridSolver(quadratic, N, settings).solve(target, start, -5.0, 1)
    np.testing.assert_array_equal(solution.best, np.asarray(start.mean))
    assert solution.cost == -5.0


def test_forward_gradient_is_the_gradient():
    target = jnp.linspace(-0.8, 0.8, N)
    point = jnp.linspace(0.3, -0.2, N)
    expected = 2 * np.logspace(0, 2, N) * (point - target)
    np.testing.assert_allclose(gradient(quadratic, target, point), expected, rtol=1e-4)
