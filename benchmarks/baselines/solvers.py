"""The solvers that Section V-C compares, by name: Algorithm 1, and the same without or with many gradient steps."""

from __future__ import annotations

from typing import Any

import jax

from contact_reach_ros.planning.solver.hybrid import Draw, HybridSolver, cheapest

_GRADIENT_STEPS = 10


class CmaSolver(HybridSolver):
    """Plain CMA-ES, without a gradient."""

    def _search_line(self, problem: Any, mean: jax.Array, draw: Draw) -> tuple[jax.Array, jax.Array]:
        points = mean[:, None]
        return points, self._cost(problem, points)


class GradientSolver(HybridSolver):
    """Algorithm 1 with ten line searches in each step, each from the best point of the one before."""

    def _search_line(self, problem: Any, mean: jax.Array, draw: Draw) -> tuple[jax.Array, jax.Array]:
        def search(index: jax.Array, last: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return super(GradientSolver, self)._search_line(problem, cheapest(*last)[0], (*draw[:-1], index))

        first = super()._search_line(problem, mean, draw)
        found: tuple[jax.Array, jax.Array] = jax.lax.fori_loop(1, _GRADIENT_STEPS, search, first)
        return found


SOLVERS: dict[str, type[HybridSolver]] = {"hybrid": HybridSolver, "cma": CmaSolver, "gradient": GradientSolver}
