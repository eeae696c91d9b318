"""Programs are kept whole between processes, and only for what they are."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arm_simulation import ARM, HOME
from planning_helpers import PERMITTED_FORCE, SMALL

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.programs import Program, UnknownValueError, at_once, describe, preparing
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.transfer.lanes import combine, rotate
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

VECTOR, COLUMNS = np.full((3, 2), 0.1, np.float32), np.repeat(np.eye(3, dtype=np.float32)[..., None], 2, axis=2)


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "contact_reach_ros" / "programs"


def never_traced() -> Program:
    program = Program(rotate)
    program._compile = None
    return program


def test_what_one_has_compiled_another_loads(cache):
    first = Program(rotate)
    with preparing():
        expected = first(VECTOR, COLUMNS)
        assert len(list(cache.iterdir())) == 2
        second = never_traced()
        np.testing.assert_array_equal(second(VECTOR, COLUMNS), expected)
    np.testing.assert_array_equal(second(VECTOR, COLUMNS), expected)


def test_other_shapes_are_compiled_as_ever(cache):
    program = Program(rotate)
    with preparing():
        program(VECTOR, COLUMNS)
    assert program(VECTOR[:, :1], COLUMNS[..., :1]).shape == (3, 3, 1)
    assert len(list(cache.iterdir())) == 2


def test_several_are_compiled_at_once_and_jax_keeps_its_cache_for_others(cache):
    programs = [Program(rotate) for _ in range(2)]
    with preparing():
        first, second = at_once(
            lambda: programs[0](VECTOR, COLUMNS), lambda: programs[1](VECTOR[:, :1], COLUMNS[..., :1])
        )
    assert first.shape == (3, 3, 2) and second.shape == (3, 3, 1)
    assert len(list(cache.iterdir())) == 4 and jax.config.jax_enable_compilation_cache


def test_damaged_files_are_made_again(cache):
    with preparing():
        expected = Program(rotate)(VECTOR, COLUMNS)
        for file in cache.iterdir():
            file.write_bytes(b"nonsense")
        np.testing.assert_array_equal(Program(rotate)(VECTOR, COLUMNS), expected)
        np.testing.assert_array_equal(never_traced()(VECTOR, COLUMNS), expected)


def test_functions_from_elsewhere_are_not_kept(cache):
    weight = 2.0
    program = Program(lambda array: weight * array)
    with preparing():
        np.testing.assert_array_equal(program(VECTOR), 2.0 * VECTOR)
    assert not cache.exists()
    with pytest.raises(UnknownValueError, match="test_functions_from_elsewhere"):
        describe(program._function)


def test_values_that_a_function_holds_are_part_of_it():
    def described(weight: float) -> object:
        return describe(functools.partial(combine, weights=[np.full(3, weight)]))

    assert described(1.0) == described(1.0) != described(2.0)
    assert describe(SMALL) == describe(dataclasses.replace(SMALL)) != describe(dataclasses.replace(SMALL, horizon=2))
    assert describe(jnp.ones(3)) == describe(np.ones(3, np.float32)) != describe(np.ones((3, 1), np.float32))


@pytest.mark.slow
def test_planner_with_loaded_programs_makes_the_same_plans(cache, quick_compilation):
    plans = []
    for number in range(2):
        planner = RecedingHorizonPlanner(ARM, SMALL, ImpedanceSettings(), PERMITTED_FORCE, capacity=0)
        if number:
            for program in (planner._predictor._run, planner._evaluate, planner._solver._step):
                program._compile = None
        planner.warm_up(lambda line: None)
        goal = Target(np.array([0.5, 0.2, 0.4]))
        plans.append(planner.plan(Request(HOME, np.zeros(ARM.n), 0, 10_000_000, goal, Spheres.none())))
    np.testing.assert_array_equal(plans[0].predicted_q, plans[1].predicted_q)
    assert plans[0].cost_terms == plans[1].cost_terms
    assert jax.config.jax_enable_compilation_cache
