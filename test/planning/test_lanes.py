"""The compiler of functions of candidates: against XLA, and where it has to give way to it."""

import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from planning_helpers import FAR_BALL, FLANGE, HOME, SMALL, ball, beside_forearm, make_objective, make_problem

from contact_reach_ros.planning.lanes import compiled, trace
from contact_reach_ros.planning.lanes.compiled import Compiled
from contact_reach_ros.planning.solver.hybrid import slopes

CANDIDATES = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 21)).astype(np.float32)
"""More than two vectors of 8 lanes, and not a multiple."""
GIVEN = {"weights": np.linspace(0.5, 1.5, 5, dtype=np.float32), "offset": np.float32(0.3)}


def both(function, given=GIVEN, candidates=CANDIDATES, source=None):
    """What the function returns by lanes and by XLA."""
    by_lane = Compiled(function, Compiled(source) if source else None)
    return [np.asarray(jax.jit(own)(given, candidates)) for own in (by_lane, function)]


def with_loops(given, candidates):
    """Loops in loops, that carry, list and stack numbers that differ between lanes, and others that do not."""

    def inner(carry, row):
        total, factor = carry
        return (total + factor * row, 0.5 * factor), row * factor

    def outer(carry, rows):
        (total, factor), stacked = jax.lax.scan(inner, (carry, given["offset"]), rows)
        return total * factor, stacked.sum(axis=0)

    rows = candidates[None] * given["weights"][:3, None, None]
    last, stacked = jax.lax.scan(outer, jnp.zeros(candidates.shape[1]), rows, reverse=True)
    return last + stacked.max(axis=0)


def with_functions(given, candidates):
    """Functions of the C library, contractions, masks and whatever else the cost has none of."""
    rows = jnp.tanh(candidates) + jnp.exp(given["offset"]) * jnp.sin(candidates) - jnp.arctan2(candidates, 2.0)
    matrix = jnp.outer(given["weights"], given["weights"]) + jnp.eye(5)
    rows = matrix @ rows + jnp.cumsum(candidates, axis=0)
    chosen = jnp.where((candidates > 0.2) & ~(candidates > 0.7), rows, jnp.sign(candidates) * candidates**3)
    chosen = jnp.where((candidates > 0.0).any(axis=0), chosen, -chosen)
    return (chosen / (1.0 + candidates**2)).sum(axis=0) + rows[::2].min(axis=0)


@pytest.mark.parametrize("function", [with_loops, with_functions])
def test_it_computes_what_xla_computes(function):
    by_lane, by_xla = both(function)
    np.testing.assert_allclose(by_lane, by_xla, rtol=2e-6, atol=2e-6)


def test_results_are_any_tree_of_arrays():
    """Of loops, of what is the same in all lanes, of candidates themselves and of constants."""

    def function(given, candidates):
        _, steps = jax.lax.scan(
            lambda total, row: (total + row, (total, given["offset"] * row)), 0.0 * candidates[0], candidates
        )
        offset = jnp.broadcast_to(given["offset"], (2, candidates.shape[1]))
        return {"steps": steps, "same": (offset, candidates), "known": jnp.ones_like(offset[:, None])}

    by_lane, by_xla = (jax.jit(own)(GIVEN, CANDIDATES) for own in (Compiled(function), function))
    jax.tree.map(lambda own, other: np.testing.assert_allclose(own, other, rtol=1e-6, atol=1e-7), by_lane, by_xla)
    assert by_lane["known"].shape == (2, 1, 21) and by_lane["steps"][1].shape == (5, 21)


def test_a_derivative_is_traced_once_and_has_the_rule_of_its_function(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    given = ({"offset": np.float32(0.5)}, CANDIDATES[:, :1])
    traced = []

    def slope(factor):
        """Of a function whose rule multiplies its derivative."""
        squared = jax.custom_jvp(lambda x: x * x)
        squared.defjvp(lambda primals, tangents: (squared(primals[0]), factor * 2.0 * primals[0] * tangents[0]))

        def function(given, candidates):
            traced.append(factor)
            return squared(given["offset"] * candidates).sum(axis=0)

        by_lane, by_xla = both(functools.partial(slopes, function), given, CANDIDATES, function)
        np.testing.assert_allclose(by_lane, by_xla, rtol=1e-6)
        return by_lane

    plain = slope(1.0)
    np.testing.assert_allclose(plain, 0.5 * (CANDIDATES[:, :1] * CANDIDATES).sum(axis=0), rtol=1e-5, atol=1e-6)
    assert traced == [1.0, 1.0, 1.0]
    np.testing.assert_array_equal(slope(1.0), plain)
    assert traced == [1.0] * 5
    np.testing.assert_array_equal(slope(2.0), 2.0 * plain)
    # The numbers of an array that the rule has, too.
    for share in (1.0, 10.0):
        slope(np.full((len(CANDIDATES), 1), share, np.float32))


@pytest.fixture(scope="module")
def space_cost():
    """Cost of actions (3, 13, B) as points (39, B)."""
    objective = make_objective()
    scale = np.array([0.01] * 3 + [0.2] * 10, np.float32)[:, None]
    return lambda problem, points: objective.cost(problem, points.reshape(3, 13, -1) * scale)


@pytest.mark.slow
@pytest.mark.parametrize("center", [FAR_BALL, beside_forearm(-0.01)], ids=["without contact", "in contact"])
def test_cost_and_gradient_of_a_plan_are_those_of_xla(space_cost, center):
    problem = make_problem(HOME, FLANGE + np.array([0.1, 0.1, -0.05]), ball(center), contact=0.01)
    random = np.random.default_rng(0)
    points = np.clip(0.3 * random.standard_normal((39, SMALL.population)), -1.0, 1.0).astype(np.float32)
    costs, reference = both(space_cost, problem, points)
    np.testing.assert_allclose(costs, reference, rtol=1e-5, atol=1e-5)
    directions = np.eye(39, dtype=np.float32)[:, ::13]
    own, expected = both(functools.partial(slopes, space_cost), (problem, points[:, :1]), directions, space_cost)
    assert np.linalg.norm(own - expected) < 3e-5 * np.linalg.norm(expected)


def test_not_a_number_comes_through():
    def spoiled(given, candidates):
        return jnp.maximum(jnp.minimum(candidates[0], candidates[1]), jnp.clip(candidates[2], -0.5, 0.5))

    candidates = CANDIDATES.copy()
    for row in range(3):
        candidates[row, row] = np.nan
    by_lane, by_xla = both(spoiled, GIVEN, candidates)
    assert np.isnan(by_lane[:3]).all()
    np.testing.assert_array_equal(by_lane, by_xla)


def test_the_same_candidates_have_the_same_bits_wherever_they_are():
    function = jax.jit(Compiled(with_functions))
    first = np.asarray(function(GIVEN, CANDIDATES))
    np.testing.assert_array_equal(first, np.asarray(function(GIVEN, CANDIDATES)))
    np.testing.assert_array_equal(first[::-1], np.asarray(function(GIVEN, CANDIDATES[:, ::-1])))
    np.testing.assert_array_equal(first[4:6], np.asarray(function(GIVEN, CANDIDATES[:, 4:6])))


def test_constants_that_differ_make_another_function():
    results = []
    for factor in (1.0, 2.0):
        table = np.full(5, factor, np.float32)[:, None]
        results.append(both(lambda given, candidates, table=table: (candidates * table).sum(axis=0))[0])
    np.testing.assert_allclose(results[1], 2.0 * results[0], rtol=1e-6)


def test_an_operation_that_it_does_not_know_is_left_to_xla_with_one_warning(caplog):
    def sorting(given, candidates):
        return jnp.sort(candidates, axis=0)[1] + given["offset"]

    function = Compiled(sorting)
    derivative = Compiled(functools.partial(slopes, sorting), function)
    with caplog.at_level(logging.WARNING):
        values = [np.asarray(jax.jit(function)(GIVEN, CANDIDATES[:, :count])) for count in (21, 8)]
        jax.jit(derivative)((GIVEN, CANDIDATES[:, :1]), CANDIDATES)
    np.testing.assert_allclose(values[0], np.sort(CANDIDATES, axis=0)[1] + 0.3, rtol=1e-6)
    np.testing.assert_array_equal(values[0][:8], values[1])
    (record,) = caplog.records
    assert "'sort'" in record.getMessage()


def test_what_is_too_large_is_left_to_xla_with_one_warning(caplog, monkeypatch, tmp_path):
    monkeypatch.setattr(trace, "MAX_NUMBERS", 10)
    # What is compiled already stays in use.
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "_engines", {})
    with caplog.at_level(logging.WARNING):
        by_lane, by_xla = both(with_functions)
    np.testing.assert_array_equal(by_lane, by_xla)
    (record,) = caplog.records
    assert "takes 10 numbers, and this has more" in record.getMessage()
