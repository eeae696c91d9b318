"""The solvers that Section V-C compares, by name: Algorithm 1, and the same without or with many gradient steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from contact_reach_ros.planning.solver.hybrid import Draw, Elite, HybridSolver, Sample, cheapest

_GRADIENT_STEPS = 10


class CmaSolver(HybridSolver):
    """Plain CMA-ES, without a gradient."""

    def _search_line(
        self, problem: Any, sample: Sample, draw: Draw, select: Callable[[jax.Array], Elite]
    ) -> tuple[Elite, jax.Array, jax.Array]:
        elite = select(self._cost(problem, sample.repaired))
        points = elite.mean[:, None]
        return elite, points, self._cost(problem, points)


class GradientSolver(HybridSolver):
    """Algorithm 1 with ten line searches in each step, each from the best point of the one before."""

    def _search_line(
        self, problem: Any, sample: Sample, draw: Draw, select: Callable[[jax.Array], Elite]
    ) -> tuple[Elite, jax.Array, jax.Array]:
        elite, points, costs = super()._search_line(problem, sample, draw, select)

        def search(index: jax.Array, last: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            points = self._points_on_line(problem, cheapest(*last)[0], draw, index)
            return points, self._cost(problem, points)

        return elite, *jax.lax.fori_loop(1, _GRADIENT_STEPS, search, (points, costs))


SOLVERS: dict[str, type[HybridSolver]] = {"hybrid": HybridSolver, "cma": CmaSolver, "gradient": GradientSolver}
