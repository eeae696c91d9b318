"""The distribution of CMA-ES."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contact_reach_ros.planning.solver.cma_es import Distribution, Rates, fresh, sample, update

N, PARENTS, POPULATION = 5, 20, 80
ALL = np.ones(PARENTS)
RATES = Rates.of(N, PARENTS)


@jax.jit
def one_update(distribution: Distribution, parents: np.ndarray, valid: np.ndarray = ALL) -> Distribution:
    """With the mean moved to that of the valid parents."""
    factor = jnp.linalg.cholesky(distribution.covariance)
    mean = distribution.mean + distribution.sigma * (parents @ valid) / jnp.maximum(valid.sum(), 1.0)
    return update(RATES, distribution, factor, parents, valid, mean)


@pytest.fixture
def start() -> Distribution:
    return fresh(jnp.zeros(N), jnp.linspace(0.5, 2.0, N))


def test_samples_have_the_covariance(start):
    steps, factor = sample(start, jax.random.PRNGKey(0), 20000)
    np.testing.assert_allclose(factor @ factor.T, start.covariance, rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.cov(steps), start.covariance, rtol=0, atol=0.1)


def test_step_size_grows_when_steps_agree_and_shrinks_when_they_cancel(start):
    spread = np.asarray(jnp.sqrt(jnp.diag(start.covariance)))
    together = np.tile(spread[:, None], (1, PARENTS))
    grown = start
    for _ in range(5):
        grown = one_update(grown, together)
    assert grown.sigma > start.sigma
    shrunk = start
    for _ in range(5):
        shrunk = one_update(shrunk, np.zeros((N, PARENTS)))
    assert shrunk.sigma < start.sigma


def test_covariance_learns_the_direction_of_success(start):
    parents = np.zeros((N, PARENTS))
    parents[0] = np.tile([-2.0, 2.0], PARENTS // 2)
    learned = start
    for _ in range(30):
        learned = one_update(learned, parents)
    covariance = np.asarray(learned.covariance)
    assert covariance[0, 0] > start.covariance[0, 0]
    assert covariance[1, 1] < start.covariance[1, 1]
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_invalid_parents_leave_no_trace(start):
    random = np.random.default_rng(0)
    parents = random.normal(size=(N, PARENTS))
    valid = np.r_[np.ones(PARENTS - 5), np.zeros(5)]
    other = parents.copy()
    other[:, PARENTS - 5 :] = 100.0
    for a, b in zip(one_update(start, parents, valid), one_update(start, other, valid), strict=True):
        np.testing.assert_array_equal(a, b)


def test_update_without_any_valid_parent_keeps_mean_and_a_finite_distribution(start):
    after = one_update(start, np.ones((N, PARENTS)), np.zeros(PARENTS))
    np.testing.assert_array_equal(after.mean, start.mean)
    assert all(np.isfinite(part).all() for part in after)
    assert np.linalg.eigvalsh(np.asarray(after.covariance)).min() > 0.0


def test_rates_add_up_to_less_than_everything():
    for n, parents in ((2, 2), (39, 50), (39, 1000)):
        rates = Rates.of(n, parents)
        assert 0.0 < rates.c_1 + rates.c_mu <= 1.0
        assert 0.0 < rates.c_sigma < 1.0
        assert 0.0 < rates.c_c < 1.0
