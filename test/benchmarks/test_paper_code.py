"""The solver of the authors' code, and the settings that stand for the rest of it."""

import numpy as np

from benchmarks.paper_code import SETTINGS, SIGMA, AuthorsCma
from contact_reach_ros.planning.terms import term_weights

N = 39
SPREAD = np.full(N, 0.02)


def test_search_finds_the_least_cost_within_the_bounds():
    aim = np.random.default_rng(0).uniform(-1.5, 1.5, N).astype(np.float32)
    solver = AuthorsCma(lambda _, points: 1.0 + ((points - aim[:, None]) ** 2).sum(axis=0), SPREAD, SETTINGS)
    assert solver.population == 14
    solver._most = 1000
    found = solver.solve(None, np.zeros(N), 100.0, number=0)
    assert np.abs(found.best - np.clip(aim, -1.0, 1.0)).max() < 0.05
    assert found.cost == found.costs[-1] < found.costs[0]


def test_candidates_beyond_the_middle_weigh_against_the_covariance():
    weights = AuthorsCma(lambda _, points: points[0], SPREAD, SETTINGS)._weights
    assert np.isclose(weights[:7].sum(), 1.0) and (weights[:7] > 0.0).all() and (weights[8:] < 0.0).all()


def test_a_search_begins_with_their_step_size():
    solver = AuthorsCma(lambda _, points: points[0], np.full(N, 0.01 / 0.0075), SETTINGS)
    assert np.allclose(solver.scale, SIGMA / 0.0075)


def test_nothing_but_their_cost_and_the_limits_of_the_arm_counts():
    counted = {name for name, weight in (term_weights(SETTINGS) | {"detour": 0.0}).items() if weight}
    assert counted == {"terminal", "contact_squared", "joint_limit", "joint_speed", "body_speed", "clearance"}
    assert SETTINGS.horizon * SETTINGS.knot_duration == 0.03
