"""The distribution of CMA-ES, against the `cma` package, and sequences read later."""

import dataclasses

import cma
import jax
import numpy as np
import pytest
from cma.utilities.math import MathHelperFunctions

from contact_reach_ros.planning.solver.cma_es import (
    SIGMA_RANGE,
    Distribution,
    Rates,
    fresh,
    sample,
    update,
)
from contact_reach_ros.planning.solver.solver import shift_solution

N, PARENTS = 5, 20
H, SIZE = 3, 2
GENERATIONS = 60


def test_invalid_parents_leave_no_trace():
    start = fresh(np.zeros(N), np.linspace(0.5, 2.0, N))
    parents = np.random.default_rng(0).normal(size=(N, PARENTS))
    valid = np.r_[np.ones(PARENTS - 5), np.zeros(5)]
    other = np.where(valid, parents, 100.0)
    first, second = (update(Rates.of(N, PARENTS), start, each, valid, np.zeros(N)) for each in (parents, other))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def turned_cigar(x: np.ndarray) -> np.ndarray:
    """Narrow about a direction that is none of the axes."""
    along = x.sum(axis=0) / np.sqrt(len(x))
    return along**2 + 1e3 * ((x**2).sum(axis=0) - along**2)


def reference(n: int, population: int, parents: int, rates: Rates) -> cma.CMAEvolutionStrategy:
    """The package's own strategy, with equal weights, the tutorial's rates (its own are newer) and our root of C."""
    options = {"verbose": -9, "popsize": population, "CMA_active": False, "updatecovwait": 0, "tolfun": 0}
    strategy = cma.CMAEvolutionStrategy(np.full(n, 0.7), 1.0, options)
    weights = strategy.sp.weights
    weights[:] = [1.0 / parents] * parents + [0.0] * (population - parents)
    weights.mu, weights.mueff = parents, float(parents)
    strategy.sp.cc, strategy.sp.c1, strategy.sp.cmu = rates.c_c, rates.c_1, rates.c_mu
    strategy.sm.parameters = lambda **_: {"c1": rates.c_1, "cmu": rates.c_mu}
    strategy.adapt_sigma.cs, strategy.adapt_sigma.damps = rates.c_sigma, rates.d_sigma
    strategy.sm.transform_inverse = lambda step: np.linalg.solve(np.linalg.cholesky(strategy.sm.C), step)
    return strategy


@pytest.mark.parametrize(("n", "population", "parents"), [(2, 12, 3), (39, 200, 50)])
def test_every_generation_is_that_of_the_cma_package(n, population, parents):
    """Both get the same candidates, ours; then mean, step size, covariance and paths agree to 1e-8."""
    rates = Rates.of(n, parents)
    # The package approximates E‖N(0, I)‖ to a few digits.
    length = MathHelperFunctions.chiN(n)
    assert rates.expected_length == pytest.approx(length, rel=1e-4)
    rates = dataclasses.replace(rates, expected_length=length)
    theirs = reference(n, population, parents, rates)
    with jax.enable_x64(True):
        draw = jax.jit(sample, static_argnums=2)
        refit = jax.jit(lambda *arguments: update(rates, *arguments))
        # The package starts a little off the identity.
        nothing = np.zeros(n)
        ours = Distribution(np.full(n, 0.7), np.float64(1.0), theirs.sm.C.copy(), nothing, nothing, np.int64(0))
        averages = []
        for generation in range(GENERATIONS):
            if theirs.sigma < 2 * SIGMA_RANGE[0]:
                break  # the package's own step size knows no bounds
            theirs.ask()
            steps = np.asarray(draw(ours, jax.random.PRNGKey(generation), population))
            points = np.asarray(ours.mean)[:, None] + float(ours.sigma) * steps
            values = turned_cigar(points)
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


@pytest.mark.parametrize("elapsed", [0.0, 0.25, 1.5, 2.9])
def test_shift_reads_the_sequence_later(elapsed):
    knots = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    shifted = shift_solution(knots.reshape(-1), H, elapsed).reshape(H, SIZE)
    np.testing.assert_allclose(shifted[:, 0], np.minimum(1.0 + np.arange(H) + elapsed, 3.0))
    np.testing.assert_allclose(shifted[:, 1], 10.0 * shifted[:, 0])
