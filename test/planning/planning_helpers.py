"""Problems and planners for the tests of planning."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from arm_simulation import ARM, HOME

from contact_reach_ros.arm import link_frames
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.planning import cost
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Problem, term_weights
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.world.spheres import Spheres

PERMITTED_FORCE = 10.0
SMALL = PlanningSettings(deadline=0.0, population=32)
"""Enough candidates for tests that are not about their number.

As many as in all other tests, which then share the compiled programs: to compile them takes longer than the tests.
"""

MS = 1_000_000
"""ns."""

LANES = 60
"""Candidates that the shared rollout takes."""

FAR_BALL = np.array([0.0, 0.0, -100.0])
ROTATIONS, ORIGINS = link_frames(ARM, HOME)
FLANGE = ORIGINS[-1]


def beside_forearm(gap: float) -> np.ndarray:
    """Centre of a ball of 0.1 m beside the forearm of the arm at home, `gap` m from its surface."""
    return ORIGINS[4] + ROTATIONS[4] @ (0.0, 0.0, 0.11) + (0.075 + 0.1 + gap) * np.array([0.0, 1.0, 0.0])


def ball_at(center: np.ndarray, stiffness: float = 100.0, damping: float = 30.0) -> Spheres:
    """One sphere of 0.1 m radius, at rest."""
    return Spheres(center[None], center[None], np.full(1, 0.1), np.full(1, stiffness), np.full(1, damping))


def ball(*values: Any) -> Obstacles:
    """The sphere of `ball_at`, as the transfer model takes it."""
    return obstacles_of(ball_at(*values))


def obstacles_of(spheres: Spheres, capacity: int | None = None) -> Obstacles:
    """Spheres as the transfer model takes them, all of them unless a capacity says otherwise."""
    obstacles = ObstacleReader(ARM, len(spheres) if capacity is None else capacity).read(HOME, spheres)
    return jax.tree.map(jnp.asarray, obstacles)


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
        weights={**term_weights(settings), "orientation": 0.0, **weights},
        permitted_force=PERMITTED_FORCE,
    )


def make_objective() -> Objective:
    return cost.make_objective(ARM, SMALL, ImpedanceSettings())


def make_planner(**changes: object) -> RecedingHorizonPlanner:
    settings = dataclasses.replace(SMALL, **changes)
    return RecedingHorizonPlanner(ARM, settings, ControllerSettings(), PERMITTED_FORCE, capacity=1)
