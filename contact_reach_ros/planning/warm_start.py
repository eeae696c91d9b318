"""What a new plan keeps of the one before: its solution and its distribution, moved on by the time that has passed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.solver.cma_es import Distribution
from contact_reach_ros.planning.transfer.lanes import single

FloatArray = NDArray[np.floating]

SIGMA_RANGE = (0.3, 3.0)
"""Step size with which a carried distribution may start, relative to the initial one: not collapsed, not exploded."""


def shift_matrix(horizon: int, elapsed: float) -> FloatArray:
    """Weights (H, H) that read a sequence of H knots `elapsed` knots later; the last knot goes on beyond the end."""
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


def shift_distribution(
    distribution: Distribution, mean: FloatArray, spread: FloatArray, horizon: int, elapsed: float
) -> Distribution:
    """The distribution read `elapsed` knots later, about a new mean (n,).

    A knot that is a mixture of two, or that lay beyond the old horizon, would have too small a variance: what the
    weights take away from it is filled up with the initial `spread` (n,).
    """
    size = len(mean) // horizon
    weights = shift_matrix(horizon, elapsed)
    # Knots beyond the old horizon are new: they carry nothing over.
    weights[np.arange(horizon) + elapsed > horizon - 1 + 1e-9] = 0.0
    kept = np.kron(weights, np.eye(size))
    filled = np.repeat(1.0 - (weights**2).sum(axis=1), size) * spread**2
    covariance = kept @ distribution.covariance @ kept.T + np.diag(filled)
    return Distribution(
        mean=single(mean),
        sigma=single(np.clip(distribution.sigma, *SIGMA_RANGE)),
        covariance=single(covariance),
        sigma_path=single(kept @ distribution.sigma_path),
        covariance_path=single(kept @ distribution.covariance_path),
        generation=distribution.generation,
    )
