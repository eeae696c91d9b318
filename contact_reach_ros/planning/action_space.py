"""The variables of a plan: references of the controller, or whatever another method commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.objectives import action_bounds, make_objective, planned
from contact_reach_ros.planning.plan import Held, Plan
from contact_reach_ros.planning.prediction import hold_at
from contact_reach_ros.planning.problem import Problem
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.pipeline import State, System

_PAPER_SIGMA = 0.01
"""Standard deviation of every variable, m or rad, in line 1 of Algorithm 1."""


class ActionSpace(Protocol):
    """Decision variables, their effect on the arm, and what is in force without a plan.

    The solver searches points (N, B) in units of the bounds, within [-1, 1].

    Attributes
    ----------
    objective
        Cost of actions.
    bounds
        (N,) bounds of the decision variables, knot after knot.
    vectors_per_knot
        Number of vectors of decision variables in a knot, one after the other in time.
    ramp_s
        Time in which what is in force moves to that of a knot, s; 0 if it steps.
    """

    objective: Objective
    bounds: Array
    vectors_per_knot: int
    ramp_s: float

    def actions(self, points: jax.Array, problem: Problem) -> jax.Array:
        """Actions (H, A, B) of points (N, B), as the objective takes them."""

    def step(self, system: System, state: State, held: Any) -> State:
        """Advance a system by one time step under what is in force."""

    def hold(self, q: Array) -> Held:
        """What is in force without a plan, at joint angles `q` (n,), rad."""

    def still(self, problem: Problem) -> Array:
        """The point (N,) that keeps the arm still."""

    def finish(self, plan: Plan, point: np.ndarray) -> Plan:
        """Complete the plan of a point (N,) with what is particular to this space."""


class ReferenceSpace:
    """References of laws (1)-(3): Δx and Δq for each knot, or the part of them that has an effect."""

    vectors_per_knot = 1

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        self._arm = arm
        self.objective = make_objective(arm, settings, gains)
        self.ramp_s = gains.reference_ramp
        self.bounds = action_bounds(arm, settings, gains)
        self._planned = np.flatnonzero(planned(arm, settings, gains))

    def actions(self, points: jax.Array, problem: Problem) -> jax.Array:
        """Actions (H, 6 + n, B) of points (N, B), with zeros for what the points leave out."""
        actions = points * self.bounds[:, None] * problem.speed_scale
        actions = actions.reshape(self.objective.horizon, -1, points.shape[1])
        missing = self.objective.system.action_size - actions.shape[1]
        if self._planned[-1] < len(self._planned):
            return jnp.pad(actions, ((0, 0), (0, missing), (0, 0)))
        whole = jnp.zeros((len(actions), self.objective.system.action_size, points.shape[1]), actions.dtype)
        return whole.at[:, self._planned].set(actions)

    def step(self, system: System, state: State, held: Any) -> State:
        """Advance under a reference."""
        return pipeline.step(system, state, held)

    def hold(self, q: Array) -> Held:
        """The pose and posture at `q` (n,)."""
        return hold_at(self._arm, q)

    def still(self, problem: Problem) -> Array:
        """The point of zero Δx and Δq."""
        return np.zeros_like(self.bounds)

    def finish(self, plan: Plan, point: np.ndarray) -> Plan:
        """The plan, unchanged."""
        return plan


def initial_spread(settings: PlanningSettings, bounds: Array) -> Array:
    """Standard deviations (N,) of a fresh search, as shares of the bounds (N,)."""
    if settings.sampling == "bounds":
        return np.full_like(bounds, settings.sigma)
    return _PAPER_SIGMA / bounds


def scaled_cost(space: ActionSpace) -> Callable[[Problem, jax.Array], jax.Array]:
    """Cost (B,) of points (N, B), for the solver to minimise."""

    def cost(problem: Problem, points: jax.Array) -> jax.Array:
        return space.objective.cost(problem, space.actions(points, problem))

    return cost
