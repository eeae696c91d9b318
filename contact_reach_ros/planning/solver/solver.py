"""The contract between the planner and a solver.

A solver searches the box [-1, 1]ⁿ. Its state means nothing to the planner, which keeps it from one plan to the next and
has the solver shift it in time.
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

State = Any
"""Whatever the solver learns, as arrays of numpy or on the device."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a search."""

    best: np.ndarray
    """(n,) within [-1, 1]."""
    cost: float
    state: State
    """State at the end of the search."""
    steps: int
    stop_reason: str
    """"stagnated", "max_steps" or "deadline"."""
    costs: tuple[float, ...]
    """Best cost at the start and after each step."""


class Solver(Protocol):
    """Minimises a cost over the box [-1, 1]ⁿ, step by step."""

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on."""

    def init(self, mean: FloatArray, spread: FloatArray) -> State:
        """State of a search that starts at `mean` (n,) with standard deviations `spread` (n,)."""

    def shift(self, state: State, mean: FloatArray, spread: FloatArray, knots: int, elapsed: float) -> State:
        """State for a search from `mean` (n,) after the variables moved on by `elapsed` of their `knots` in time.

        `spread` (n,) is that of variables that the state does not cover.
        """

    def solve(self, problem: Any, state: State, start_cost: float, number: int, until: float = math.inf) -> Solution:
        """Search for the minimum; the solution is never worse than the state's mean.

        Parameters
        ----------
        problem
            Passed on to the cost function.
        state
            Start of the search.
        start_cost
            Cost of the state's mean; infinity if it is not finite.
        number
            Selects the random numbers, together with the seed.
        until
            Instant of `time.perf_counter` by which to return, checked between steps; at least one is taken.
        """


FloatArray = NDArray[np.floating]


def shift_matrix(horizon: int, elapsed: float) -> FloatArray:
    """Weights (H, H) that read a sequence of H knots `elapsed` knots later; the last knot continues beyond the end."""
    instants = np.minimum(np.arange(horizon) + elapsed, horizon - 1)
    before = np.floor(instants).astype(int)
    share = instants - before
    weights = np.zeros((horizon, horizon))
    rows = np.arange(horizon)
    weights[rows, before] += 1.0 - share
    weights[rows, np.minimum(before + 1, horizon - 1)] += share
    return weights


def shift_solution(solution: FloatArray, horizon: int, elapsed: float) -> FloatArray:
    """The solution (n,) read `elapsed` knots later."""
    return (shift_matrix(horizon, elapsed) @ solution.reshape(horizon, -1)).reshape(-1)
