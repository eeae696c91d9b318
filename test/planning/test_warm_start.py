"""What a plan keeps of the one before."""

import numpy as np
import pytest

from contact_reach_ros.planning.solver.cma_es import Distribution, fresh, shift_distribution
from contact_reach_ros.planning.solver.solver import shift_solution

H, SIZE = 3, 2
SPREAD = np.tile([0.3, 0.6], H)


def distribution(seed: int = 0) -> Distribution:
    random = np.random.default_rng(seed)
    root = random.normal(size=(H * SIZE, H * SIZE))
    paths = random.normal(size=(2, H * SIZE))
    return Distribution(
        mean=np.zeros(H * SIZE),
        sigma=np.float32(0.7),
        covariance=root @ root.T + np.eye(H * SIZE),
        sigma_path=paths[0],
        covariance_path=paths[1],
        generation=np.int32(4),
    )


@pytest.mark.parametrize("elapsed", [0.0, 0.25, 1.0, 1.5, 2.9])
def test_shift_reads_the_sequence_later(elapsed):
    knots = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    shifted = shift_solution(knots.reshape(-1), H, elapsed).reshape(H, SIZE)
    np.testing.assert_allclose(shifted[:, 0], np.minimum(1.0 + np.arange(H) + elapsed, 3.0))
    np.testing.assert_allclose(shifted[:, 1], 10.0 * shifted[:, 0])


def test_whole_knots_move_blocks_and_start_the_last_one_afresh():
    old = distribution()
    new = shift_distribution(old, old.mean, SPREAD, H, 1.0)
    np.testing.assert_allclose(new.covariance[:4, :4], old.covariance[2:, 2:], rtol=1e-5)
    np.testing.assert_allclose(new.covariance[4:, 4:], np.diag(SPREAD[:SIZE] ** 2), rtol=1e-5)
    np.testing.assert_allclose(new.covariance_path, np.r_[old.covariance_path[2:], 0.0, 0.0], rtol=1e-5)


def test_collapsed_and_exploded_step_sizes_are_brought_back():
    # The more variables, the wider the search may stay: up to those of seven joints.
    for per_knot, largest in ((SIZE, 1.0), (6, 18 / 13), (13, 3.0), (20, 3.0)):
        mean = np.zeros(H * per_knot, np.float32)
        for sigma, expected in ((1e-3, 0.3), (0.8, 0.8), (9.0, largest)):
            old = fresh(mean, np.full_like(mean, 0.3))._replace(sigma=np.float32(sigma))
            assert shift_distribution(old, mean, np.asarray(old.mean) + 0.3, H, 0.4).sigma == pytest.approx(expected)
