"""Compiled programs that several tests share: compiling them takes most of the time of these tests."""

from collections.abc import Callable, Iterator

import jax
import numpy as np
import pytest
from planning_helpers import make_objective, make_planner

from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.terms import Problem, Rollout


@pytest.fixture(scope="module")
def quick_compilation() -> Iterator[None]:
    """Let XLA leave out most optimisations: 0.4 of the time to compile, for programs that take 7 times as long to run.

    What a program computes is the same to rounding. Optimised ones run in the episodes and stacks of other folders.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="session")
def objective() -> Objective:
    return make_objective()


@pytest.fixture(scope="session")
def roll_out(objective: Objective) -> Callable[[Problem, np.ndarray], tuple[Rollout, dict[str, np.ndarray]]]:
    """Rollout and cost terms of problems with one sphere and `LANES` candidates."""

    def run(problem: Problem, actions: jax.Array) -> tuple[Rollout, dict[str, jax.Array]]:
        rollout = objective.roll_out(problem, actions)
        return rollout, objective.terms(problem, actions, rollout)

    return jax.jit(run)


@pytest.fixture(scope="session")
def warm_planner() -> RecedingHorizonPlanner:
    planner = make_planner()
    planner.warm_up(lambda line: None)
    return planner


@pytest.fixture
def planner(warm_planner: RecedingHorizonPlanner) -> RecedingHorizonPlanner:
    """A planner for one sphere that has made no plan since its last reset."""
    warm_planner.reset()
    return warm_planner
