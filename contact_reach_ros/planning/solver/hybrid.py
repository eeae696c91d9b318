"""The hybrid solver, Algorithm 1, for any objective that costs many candidates at once."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import Distribution, Rates, sample, update

ProblemT = TypeVar("ProblemT")
CostFunction = Callable[[ProblemT, jax.Array], jax.Array]
"""Costs (B,) of candidates (n, B) for a problem, any tree of arrays."""

GRADIENT_REACH = 2.0
"""β = 1 moves the variable with the steepest slope by this, from one side of its bounds to the other."""


class Search(NamedTuple):
    """Where the solver stands after a step."""

    distribution: Distribution
    best: jax.Array
    """(n,) best mean so far."""
    best_cost: jax.Array
    """()."""
    rejected: jax.Array
    """() candidates so far whose cost was not finite."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What the solver found."""

    best: np.ndarray
    """(n,) within [-1, 1]."""
    cost: float
    distribution: Distribution
    steps: int
    stop_reason: str
    """"stagnated", "max_steps" or "deadline"."""
    rejected: int
    costs: tuple[float, ...]
    """Best cost at the start and after each step."""


class HybridSolver(Generic[ProblemT]):
    """Minimises a cost over the box [-1, 1]ⁿ.

    Readings of Algorithm 1: line 9 takes a logarithm of the cost, which may be negative; α d_i, the logarithm's effect,
    is used directly as |L(a_i)|. By default a quadratic distance takes its place, which needs one evaluation per
    candidate instead of two. Line 16 descends, along the gradient in the metric of the bounds, scaled so that β = 1
    spans the box; β is drawn denser towards zero, zero included, and candidates of the line search are clipped too.
    """

    def __init__(self, cost: CostFunction, n: int, settings: PlanningSettings) -> None:
        self._cost = cost
        self._settings = settings
        self._rates = Rates.of(n, settings.elite)
        self._gradient_steps = {"hybrid": 1, "cma": 0, "gradient": settings.gradient_steps}[settings.solver]
        self._step = jax.jit(self._advance)

    def solve(
        self,
        problem: ProblemT,
        distribution: Distribution,
        start_cost: float,
        number: int,
        until: float = math.inf,
    ) -> Solution:
        """Run Algorithm 1; the solution is never worse than the mean that it starts from.

        Parameters
        ----------
        problem
            Passed on to the cost function.
        distribution
            Where to start.
        start_cost
            Cost of the distribution's mean; infinity if it is not finite.
        number
            Selects the random numbers, together with the seed of the settings.
        until
            Instant of `time.perf_counter` by which to return, looked at between steps.
        """
        settings = self._settings
        search = Search(distribution, distribution.mean, jnp.float32(start_cost), jnp.int32(0))
        costs = [start_cost]
        stagnant, longest_step, reason = 0, 0.0, "max_steps"
        now = time.perf_counter()
        while len(costs) <= settings.max_steps:
            if now + longest_step > until:
                reason = "deadline"
                break
            search = self._step(problem, search, (settings.seed, number, len(costs)))
            costs.append(float(search.best_cost))
            longest_step, now = max(longest_step, time.perf_counter() - now), time.perf_counter()
            # From an infinite cost to an infinite cost the decrease is not a number, which counts as stagnant too.
            stagnant = 0 if costs[-2] - costs[-1] >= settings.stagnation_tolerance else stagnant + 1
            if stagnant == settings.stagnation_steps:
                reason = "stagnated"
                break
        return Solution(
            best=np.asarray(search.best),
            cost=costs[-1],
            distribution=jax.tree.map(np.asarray, search.distribution),
            steps=len(costs) - 1,
            stop_reason=reason,
            rejected=int(search.rejected),
            costs=tuple(costs),
        )

    def warm_up(self, problem: ProblemT, distribution: Distribution) -> None:
        """Compile what `solve` needs for problems of this shape."""
        search = Search(distribution, distribution.mean, jnp.float32(0.0), jnp.int32(0))
        jax.block_until_ready(self._step(problem, search, (self._settings.seed, 0, 0)))

    def _advance(self, problem: ProblemT, search: Search, draw: tuple[jax.Array, jax.Array, jax.Array]) -> Search:
        """One step of Algorithm 1, lines 5 to 18; `draw` is (seed, plan number, step)."""
        seed, number, step = draw
        key = jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(seed), number), step)
        sample_key, line_key = jax.random.split(key)
        old = search.distribution
        candidates, factor = sample(old, sample_key, self._settings.population)
        costs, rejected = _ranked(self._penalised(problem, old.mean[:, None] + old.sigma * candidates))
        best_costs, elite = jax.lax.top_k(-costs, self._settings.elite)
        valid = jnp.isfinite(best_costs).astype(candidates.dtype)
        parents = candidates[:, elite]
        mean = old.mean + old.sigma * (parents @ valid) / jnp.maximum(valid.sum(), 1.0)
        mean = jnp.clip(mean, -1.0, 1.0)
        if self._gradient_steps:
            mean, cost, rejected_on_line = self._descend(problem, mean, line_key)
            rejected = rejected + rejected_on_line
        else:
            cost = _ranked(self._cost(problem, mean[:, None]))[0][0]
        better = cost < search.best_cost
        return Search(
            distribution=update(self._rates, old, factor, parents, valid, mean),
            best=jnp.where(better, mean, search.best),
            best_cost=jnp.where(better, cost, search.best_cost),
            rejected=search.rejected + rejected,
        )

    def _penalised(self, problem: ProblemT, points: jax.Array) -> jax.Array:
        """Lines 7 to 10: costs (k,) of the repaired candidates, with a penalty on those that left the box."""
        repaired = jnp.clip(points, -1.0, 1.0)
        if self._settings.boundary_penalty == "quadratic":
            distance = ((points - repaired) ** 2).sum(axis=0)
            return self._cost(problem, repaired) + self._settings.boundary_weight * distance
        both = self._cost(problem, jnp.concatenate([repaired, points], axis=1))
        population = points.shape[1]
        outside = jnp.any(points != repaired, axis=0)
        return both[:population] + jnp.where(outside, jnp.abs(both[population:]), 0.0)

    def _descend(self, problem: ProblemT, mean: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Lines 14 to 17, once or many times: the new mean (n,), its cost and the number of rejected points."""

        def descend(index: int, carry: tuple) -> tuple:
            mean, _, rejected = carry
            mean, cost, more = self._line_search(problem, mean, jax.random.fold_in(key, index))
            return mean, cost, rejected + more

        start = (mean, jnp.array(jnp.inf, mean.dtype), jnp.zeros((), jnp.int32))
        if self._gradient_steps == 1:
            return descend(0, start)
        return jax.lax.fori_loop(0, self._gradient_steps, descend, start)

    def _line_search(self, problem: ProblemT, mean: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        slope = gradient(self._cost, problem, mean)
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        direction = GRADIENT_REACH * slope / (jnp.abs(slope).max() + 1e-12)
        beta = jax.random.uniform(key, (self._settings.line_search_points,), mean.dtype) ** 2
        beta = beta.at[0].set(0.0)
        points = jnp.clip(mean[:, None] - direction[:, None] * beta, -1.0, 1.0)
        costs, rejected = _ranked(self._cost(problem, points))
        index = jnp.argmin(costs)
        return points[:, index], costs[index], rejected


def gradient(cost: CostFunction, problem: ProblemT, point: jax.Array) -> jax.Array:
    """∂L/∂a (n,) at a point (n,), in forward mode with the variables as lanes.

    Reverse mode at one lane is as fast for n = 39, but takes three times as long to compile.
    """
    n = point.shape[0]
    spread = jnp.broadcast_to(point[:, None], (n, n))
    return jax.jvp(lambda points: cost(problem, points), (spread,), (jnp.eye(n, dtype=point.dtype),))[1]


def _ranked(costs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Costs with infinity where they are not finite, so that those come last, and how many those are."""
    finite = jnp.isfinite(costs)
    return jnp.where(finite, costs, jnp.inf), (~finite).sum().astype(jnp.int32)
