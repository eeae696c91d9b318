"""The solution of the previous plan as a start for the next one, shifted by the elapsed time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
