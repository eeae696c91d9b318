"""Compiled programs that several tests share: compiling them takes most of the time of these tests."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, Problem, Rollout, Weights
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.model import default_arm
from contact_reach_ros.planning.transfer.pipeline import System

PERMITTED_FORCE = 10.0
SMALL = PlanningSettings(deadline=0.0, population=64, elite=16, line_search_points=64)
"""Enough candidates for tests that are not about their number."""

FAR_BALL = np.array([0.0, 0.0, -100.0])


def ball(center: np.ndarray, stiffness: float = 100.0, rest: np.ndarray | None = None) -> Obstacles:
    """One sphere of 0.1 m radius, as the transfer model takes it."""
    return Obstacles(
        center=jnp.asarray(center)[:, None, None],
        rest=jnp.asarray(center if rest is None else rest)[:, None, None],
        radius=jnp.full((1, 1), 0.1),
        stiffness=jnp.full((1, 1), stiffness),
        damping=jnp.full((1, 1), 30.0),
    )


def make_problem(
    q: np.ndarray, goal: np.ndarray, obstacles: Obstacles | None, settings: PlanningSettings = SMALL, **weights: float
) -> Problem:
    """A problem at rest; joint angles `q` are (7,) or (7, B), further arguments replace weights of the cost."""
    q = q.reshape(7, -1)
    return Problem(
        q=jnp.asarray(q),
        v=jnp.zeros_like(jnp.asarray(q)),
        obstacles=obstacles,
        goal_position=jnp.asarray(goal)[:, None],
        goal_rotation=jnp.eye(3)[:, :, None],
        weights=Weights.of(settings, PERMITTED_FORCE)._replace(**{"orientation": 0.0, **weights}),
    )


def make_objective(measure: str = "largest") -> Objective:
    system = System(default_arm(), ImpedanceSettings(), SMALL.contact_stiffness, SMALL.knot_duration / SMALL.substeps)
    return Objective(system, SMALL.horizon, SMALL.substeps, measure)


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


LANES = 60


def make_planner(**changes: object) -> RecedingHorizonPlanner:
    settings = dataclasses.replace(SMALL, **changes)
    return RecedingHorizonPlanner(settings, ImpedanceSettings(), PERMITTED_FORCE, capacity=1)


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
