"""The contract between the planner and a solver.

A solver searches the box [-1, 1]ⁿ around a start, and remembers nothing from one search to the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import numpy as np
from numpy.typing import NDArray

CostFunction = Callable[[Any, jax.Array], jax.Array]
"""Costs (B,) of candidates (n, B) for a problem, which is any tree of arrays."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a search."""

    best: np.ndarray
    """(n,) within [-1, 1]."""
    cost: float
    steps: int
    stop_reason: str
    """"stagnated", "max_steps" or "deadline"."""
    costs: tuple[float, ...]
    """Best cost at the start and after each step."""


class Solver(Protocol):
    """Minimises a cost over the box [-1, 1]ⁿ, step by step."""

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on."""

    def solve(
        self, problem: Any, start: FloatArray, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        """Search for the minimum; the solution is never worse than the start.

        Parameters
        ----------
        problem
            Passed on to the cost function.
        start
            (n,) where the search begins.
        start_cost
            Cost there; infinity if it is not finite.
        number
            Selects the random numbers, together with the seed.
        until
            Instant of `time.perf_counter` by which to return, checked between steps; at least one is taken.
        """


FloatArray = NDArray[np.floating]


def shift_solution(solution: FloatArray, horizon: int, elapsed: float) -> FloatArray:
    """The solution (n,), a sequence of knots, read `elapsed` knots later; the last knot continues beyond the end."""
    knots = solution.reshape(horizon, -1)
    instants = np.minimum(np.arange(horizon) + elapsed, horizon - 1)
    before = np.floor(instants).astype(int)
    share = (instants - before)[:, None]
    return ((1.0 - share) * knots[before] + share * knots[np.minimum(before + 1, horizon - 1)]).reshape(-1)
