"""The hybrid solver, Algorithm 1: sampling by CMA-ES and one gradient step per iteration."""

from __future__ import annotations

import functools
import math
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.lanes.compiled import Compiled
from contact_reach_ros.planning.settings import PAPER, PlanningSettings
from contact_reach_ros.planning.solver.cma_es import Distribution, Rates, fresh, sample, update
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solution
from contact_reach_ros.planning.transfer.arithmetic import single

Draw = tuple[int | jax.Array, ...]
"""Numbers that select the random numbers: seed, plan number, step and so on."""

STAGNATION_TOLERANCE, STAGNATION_STEPS = 1e-4, 3
"""Decrease of the cost below which a step counts as stagnant, 0.1 mm of the way to the goal, and how many in a row end
the search."""

_BOUNDARY_WEIGHT = 0.3
"""Penalty of candidates at a distance of γ outside, relative to the spread of the elite's costs: few remain there."""

GRADIENT_REACH = 2.0
"""β = 1 moves the variable with the steepest slope by this: from one side of its bounds to the other."""


class Search(NamedTuple):
    """State of the search after a step."""

    distribution: Distribution
    best: jax.Array
    """(n,) best mean so far."""
    best_cost: jax.Array
    """()."""


class HybridSolver:
    """Algorithm 1 over the box [-1, 1]ⁿ. Each search begins with a fresh distribution about its start.

    Readings of Algorithm 1: line 9 takes a logarithm of the cost, which may be negative; α d_i, the logarithm's effect,
    is used directly as |L(a_i)|. By default it is replaced by the squared distance to the box, scaled by how much the
    best candidates differ in cost, which needs one evaluation per candidate instead of two. Line 16 descends, along the
    gradient in the metric of the bounds, scaled so that β = 1 spans the box; β is drawn more densely towards zero, zero
    included, and candidates of the line search are clipped too.

    Parameters
    ----------
    cost
        Cost to minimise.
    spread
        (n,) standard deviations of the variables when a search begins.
    settings
        Settings of the planner.

    Attributes
    ----------
    max_steps
        Greatest number of steps of a search.
    stagnation_steps
        Stagnant steps in a row that end it.
    """

    def __init__(self, cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> None:
        self._cost = Compiled(cost)
        self._slopes = Compiled(functools.partial(slopes, cost), self._cost)
        self._settings = settings
        self._spread = spread
        self._seed = 0
        self.max_steps = settings.max_steps
        self.stagnation_steps = STAGNATION_STEPS
        self._rates = Rates.of(len(spread), settings.elite)
        self._step = jax.jit(self._advance)

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on, without recompilation."""
        self._seed = seed

    def solve(
        self, problem: Any, start: FloatArray, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        """Run Algorithm 1, as `Solver.solve`."""
        distribution = fresh(start, self._spread)
        search = Search(distribution, distribution.mean, single(start_cost))
        costs = [start_cost]
        stagnant, longest_step, reason = 0, 0.0, "max_steps"
        now = time.perf_counter()
        while len(costs) <= self.max_steps:
            # One step is always taken: on a machine too busy for the deadline, plans must still make progress.
            if len(costs) > 1 and now + longest_step > until:
                reason = "deadline"
                break
            search = self._step(problem, search, (self._seed, number, len(costs)))
            costs.append(float(search.best_cost))
            longest_step, now = max(longest_step, time.perf_counter() - now), time.perf_counter()
            # From one infinite cost to another the decrease is NaN, which counts as stagnant too.
            stagnant = 0 if costs[-2] - costs[-1] >= STAGNATION_TOLERANCE else stagnant + 1
            if stagnant == self.stagnation_steps:
                reason = "stagnated"
                break
        return Solution(
            best=np.asarray(search.best),
            cost=costs[-1],
            steps=len(costs) - 1,
            stop_reason=reason,
            costs=tuple(costs),
        )

    def _advance(self, problem: Any, search: Search, draw: Draw) -> Search:
        """One step of Algorithm 1, lines 5 to 18, all in one program."""
        distribution = search.distribution
        # Lines 6 and 7: y = (a_i − m) / σ, a_i and a_r, (n, k) each.
        steps = sample(distribution, seeded_key(draw, 0), self._settings.population)
        points = distribution.mean[:, None] + distribution.sigma * steps
        repaired = jnp.clip(points, -1.0, 1.0)
        # Lines 8 to 13, of which candidates without a finite cost are no part.
        costs = self._cost(problem, repaired)
        penalty = self._penalty(problem, points, repaired, costs)
        best, index = jax.lax.top_k(-ranked_costs(costs + penalty), self._settings.elite)
        valid, elite = jnp.isfinite(best).astype(costs.dtype), steps[:, index]
        mean = distribution.mean + distribution.sigma * (elite @ valid) / jnp.maximum(valid.sum(), 1.0)
        # Lines 14 to 18.
        mean, cost = cheapest(*self._search_line(problem, jnp.clip(mean, -1.0, 1.0), (*draw, 0)))
        better = cost < search.best_cost - STAGNATION_TOLERANCE
        return Search(
            distribution=update(self._rates, distribution, elite, valid, mean),
            best=jnp.where(better, mean, search.best),
            best_cost=jnp.where(better, cost, search.best_cost),
        )

    def _penalty(self, problem: Any, points: jax.Array, repaired: jax.Array, costs: jax.Array) -> jax.Array:
        """Line 9: the penalty (k,) of points (n, k) that were repaired, at these costs (k,)."""
        if self._settings.sampling == PAPER:
            return jnp.where((points != repaired).any(axis=0), jnp.abs(self._cost(problem, points)), 0.0)
        # In proportion to the spread among the best, so that cost and penalty have similar magnitudes.
        best, _ = jax.lax.top_k(-ranked_costs(costs), self._settings.elite)
        spread = jnp.where(jnp.isfinite(best[-1]), best[0] - best[-1], 0.0)
        return _BOUNDARY_WEIGHT * spread * ((points - repaired) ** 2).sum(axis=0)

    def _search_line(self, problem: Any, mean: jax.Array, draw: Draw) -> tuple[jax.Array, jax.Array]:
        """Lines 14 and 15: points (n, k) along the descent direction, the mean (n,) first, and their costs (k,)."""
        directions = jnp.eye(len(mean), dtype=mean.dtype)
        slope = self._slopes((problem, mean[:, None]), directions)
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        direction = GRADIENT_REACH * slope / (jnp.abs(slope).max() + 1e-12)
        beta = jax.random.uniform(seeded_key(draw, 1), (self._settings.population,), mean.dtype) ** 2
        beta = beta.at[0].set(0.0)
        points = jnp.clip(mean[:, None] - direction[:, None] * beta, -1.0, 1.0)
        return points, self._cost(problem, points)


def slopes(cost: CostFunction, given: tuple[Any, jax.Array], directions: jax.Array) -> jax.Array:
    """Derivatives (B,) of the cost along directions (n, B), for a problem and at a point (n, 1).

    In forward mode, with the directions as lanes: reverse mode is slower for n = 39.
    """
    problem, point = given
    points = jnp.broadcast_to(point, directions.shape)
    derivatives: jax.Array = jax.jvp(functools.partial(cost, problem), (points,), (directions,))[1]
    return derivatives


def ranked_costs(costs: jax.Array) -> jax.Array:
    """Costs with infinity where they are not finite, so that those rank last."""
    return jnp.where(jnp.isfinite(costs), costs, jnp.inf)


def cheapest(points: jax.Array, costs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The point (n,) with the least cost of points (n, B), and its cost."""
    ranked = ranked_costs(costs)
    index = jnp.argmin(ranked)
    return points[:, index], ranked[index]


def seeded_key(draw: Draw, purpose: int) -> jax.Array:
    """Random key of a draw, different for each purpose."""
    key = jax.random.PRNGKey(draw[0])
    for number in (*draw[1:], purpose):
        key = jax.random.fold_in(key, number)
    return key
