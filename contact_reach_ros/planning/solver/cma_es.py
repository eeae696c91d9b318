"""CMA-ES after Hansen's tutorial (2016), with the plain mean of the best candidates, as in line 13 of Algorithm 1."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from contact_reach_ros.planning.solver.solver import FloatArray
from contact_reach_ros.planning.transfer.arithmetic import single

SIGMA_RANGE = (1e-3, 10.0)
"""Range of the step size, whose initial value is 1."""


class Distribution(NamedTuple):
    """N(mean, sigma² covariance) with its evolution paths, over n variables."""

    mean: jax.Array
    """(n,)."""
    sigma: jax.Array
    """() step size, 1 at first: the covariance holds the scale."""
    covariance: jax.Array
    """(n, n)."""
    sigma_path: jax.Array
    """(n,) p_σ."""
    covariance_path: jax.Array
    """(n,) p_c."""
    generation: jax.Array | np.int32
    """() number of updates since the paths were zero."""


def fresh(mean: FloatArray, spread: FloatArray) -> Distribution:
    """A distribution about `mean` (n,) with independent variables of standard deviations `spread` (n,)."""
    zero = single(np.zeros(len(mean)))
    return Distribution(single(mean), single(1.0), single(np.diag(single(spread) ** 2)), zero, zero, np.int32(0))


@dataclass(frozen=True)
class Rates:
    """Learning rates for n variables and μ equally weighted parents, in the tutorial's notation."""

    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    expected_length: float
    """E‖N(0, I)‖."""
    parents: int
    """μ, which is also μ_eff for equal weights."""

    @classmethod
    def of(cls, n: int, parents: int) -> Rates:
        """The tutorial's defaults, its equations (49) to (58)."""
        c_sigma = (parents + 2) / (n + parents + 5)
        c_1 = 2 / ((n + 1.3) ** 2 + parents)
        return cls(
            c_sigma=c_sigma,
            d_sigma=1 + 2 * max(0.0, math.sqrt((parents - 1) / (n + 1)) - 1) + c_sigma,
            c_c=(4 + parents / n) / (n + 4 + 2 * parents / n),
            c_1=c_1,
            c_mu=min(1 - c_1, 2 * (parents - 2 + 1 / parents) / ((n + 2) ** 2 + parents)),
            expected_length=math.sqrt(2) * math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2)),
            parents=parents,
        )


def sample(distribution: Distribution, key: jax.Array, population: int) -> jax.Array:
    """Draw y ~ N(0, C), (n, k)."""
    n = distribution.mean.shape[0]
    normal = jax.random.normal(key, (n, population), distribution.mean.dtype)
    return jnp.linalg.cholesky(distribution.covariance) @ normal


def update(
    rates: Rates,
    distribution: Distribution,
    parents: jax.Array,
    valid: jax.Array,
    mean: jax.Array,
) -> Distribution:
    """The distribution after one generation.

    Parameters
    ----------
    distribution
        Distribution that the parents were drawn from.
    parents
        (n, μ) the best y = (x − mean) / σ.
    valid
        (μ,) which of them had a finite cost; the others have no effect.
    mean
        (n,) the new mean, whatever its origin.
    """
    dimension = distribution.mean.shape[0]
    share = valid / jnp.maximum(valid.sum(), 1.0)
    step = parents @ share
    # Equation (43) takes the symmetric root of C, which costs more than all the rest. The Cholesky factor hardly turns
    # from one generation to the next (Krause, Arbonès and Igel 2016).
    whitened = solve_triangular(jnp.linalg.cholesky(distribution.covariance), step, lower=True)
    c_sigma, c_c = rates.c_sigma, rates.c_c
    sigma_path = (1 - c_sigma) * distribution.sigma_path
    sigma_path = sigma_path + math.sqrt(c_sigma * (2 - c_sigma) * rates.parents) * whitened
    generation = distribution.generation + 1
    length = jnp.linalg.norm(sigma_path)
    # Equation (47): stall the covariance path while the step size is growing fast.
    unbiased = length / jnp.sqrt(1 - (1 - c_sigma) ** (2 * generation))
    moving = (unbiased < (1.4 + 2 / (dimension + 1)) * rates.expected_length).astype(step.dtype)
    covariance_path = (1 - c_c) * distribution.covariance_path
    covariance_path = covariance_path + moving * math.sqrt(c_c * (2 - c_c) * rates.parents) * step
    old = distribution.covariance
    rank_one = jnp.outer(covariance_path, covariance_path) + (1 - moving) * c_c * (2 - c_c) * old
    rank_mu = (parents * share) @ parents.T
    kept = 1 - rates.c_1 - rates.c_mu * (valid.sum() > 0)
    covariance = kept * old + rates.c_1 * rank_one + rates.c_mu * rank_mu
    growth = jnp.exp(jnp.clip((c_sigma / rates.d_sigma) * (length / rates.expected_length - 1), -1.0, 1.0))
    sigma = jnp.clip(distribution.sigma * growth, *SIGMA_RANGE)
    return Distribution(mean, sigma, covariance, sigma_path, covariance_path, generation)
