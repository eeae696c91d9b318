"""The distribution of CMA-ES, alone and against the reference implementation, the `cma` package."""

import cma
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cma.utilities.math import MathHelperFunctions

from contact_reach_ros.planning.solver.cma_es import SIGMA_RANGE, Distribution, Rates, fresh, sample, update

N, PARENTS, POPULATION = 5, 20, 80
ALL = np.ones(PARENTS)
RATES = Rates.of(N, PARENTS)


@jax.jit
def one_update(distribution: Distribution, parents: np.ndarray, valid: np.ndarray = ALL) -> Distribution:
    """With the mean moved to that of the valid parents."""
    mean = distribution.mean + distribution.sigma * (parents @ valid) / jnp.maximum(valid.sum(), 1.0)
    return update(RATES, distribution, parents, valid, mean)


@pytest.fixture
def start() -> Distribution:
    return fresh(jnp.zeros(N), jnp.linspace(0.5, 2.0, N))


def test_invalid_parents_leave_no_trace(start):
    random = np.random.default_rng(0)
    parents = random.normal(size=(N, PARENTS))
    valid = np.r_[np.ones(PARENTS - 5), np.zeros(5)]
    other = parents.copy()
    other[:, PARENTS - 5 :] = 100.0
    for a, b in zip(one_update(start, parents, valid), one_update(start, other, valid), strict=True):
        np.testing.assert_array_equal(a, b)


GENERATIONS = 80


def ellipsoid(x: np.ndarray) -> np.ndarray:
    return (np.logspace(0, 4, len(x))[:, None] * x**2).sum(axis=0)


def turned_cigar(x: np.ndarray) -> np.ndarray:
    """Narrow about a direction that is none of the axes."""
    along = x.sum(axis=0) / np.sqrt(len(x))
    return along**2 + 1e3 * ((x**2).sum(axis=0) - along**2)


def reference(n: int, population: int, parents: int, rates: Rates) -> cma.CMAEvolutionStrategy:
    """The package's own strategy, with equal weights and the tutorial's rates and criterion (its own are newer)."""
    # The package approximates E‖N(0, I)‖ to a few digits.
    MathHelperFunctions._chiN_dict[n] = rates.expected_length
    options = {"verbose": -9, "popsize": population, "CMA_active": False, "updatecovwait": 0, "tolfun": 0}
    strategy = cma.CMAEvolutionStrategy(np.full(n, 0.7), 1.0, options)
    weights = strategy.sp.weights
    weights[:] = [1.0 / parents] * parents + [0.0] * (population - parents)
    weights.mu, weights.mueff = parents, float(parents)
    strategy.sp.cc, strategy.sp.c1, strategy.sp.cmu = rates.c_c, rates.c_1, rates.c_mu
    strategy.sm.parameters = lambda **_: {"c1": rates.c_1, "cmu": rates.c_mu}
    adaptation = strategy.adapt_sigma
    adaptation.cs, adaptation.damps = rates.c_sigma, rates.d_sigma

    def moving(es: cma.CMAEvolutionStrategy) -> bool:
        adaptation._update_ps(es)
        unbiased = np.linalg.norm(adaptation.ps) / np.sqrt(1 - (1 - rates.c_sigma) ** (2 * es.countiter))
        return unbiased < (1.4 + 2 / (n + 1)) * rates.expected_length

    adaptation.hsig = moving
    return strategy


@pytest.mark.parametrize("function", [ellipsoid, turned_cigar])
@pytest.mark.parametrize(("n", "population", "parents"), [(2, 12, 3), (39, 200, 50)])
def test_every_generation_is_that_of_the_cma_package(function, n, population, parents):
    """Both get the same candidates, ours; then mean, step size, covariance and paths agree to 1e-8."""
    rates = Rates.of(n, parents)
    theirs = reference(n, population, parents, rates)
    with jax.enable_x64(True):
        draw = jax.jit(sample, static_argnums=2)
        refit = jax.jit(lambda *arguments: update(rates, *arguments))
        # The package starts a little off the identity.
        ours = fresh(jnp.full(n, 0.7), jnp.ones(n))._replace(covariance=jnp.array(theirs.sm.C))
        averages = []
        for generation in range(GENERATIONS):
            if theirs.sigma < 2 * SIGMA_RANGE[0]:
                break  # the package's own step size knows no bounds
            theirs.ask()
            steps = np.asarray(draw(ours, jax.random.PRNGKey(generation), population))
            points = np.asarray(ours.mean)[:, None] + float(ours.sigma) * steps
            values = function(points)
            theirs.tell(list(points.T), list(values), check_points=False)
            order = np.argsort(values)[:parents]
            averages.append(values.mean())
            mean = points[:, order].mean(axis=1)
            ours = refit(ours, steps[:, order], np.ones(parents), mean)
            scale = np.abs(theirs.sm.C).max()
            np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-8, atol=1e-8)
            np.testing.assert_allclose(ours.sigma, theirs.sigma, rtol=1e-8)
            np.testing.assert_allclose(ours.covariance, theirs.sm.C, rtol=0, atol=1e-8 * scale)
            np.testing.assert_allclose(ours.sigma_path, theirs.adapt_sigma.ps, rtol=0, atol=1e-8 * np.sqrt(n))
            np.testing.assert_allclose(ours.covariance_path, theirs.pc, rtol=0, atol=1e-8 * np.sqrt(scale * n))
    assert len(averages) > 20
    assert averages[-1] < 0.5 * averages[0]
