"""Decision variables of the planner, with their bounds and cost, made from its settings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective
from contact_reach_ros.planning.problem import Problem
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.closed_loop import N_TASK
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.planning.transfer.pipeline import System

_PAPER_SIGMA = 0.01
"""Standard deviation of every variable, m or rad, in line 1 of Algorithm 1."""


def make_objective(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> Objective:
    """The cost over the transfer function that `settings.pipeline` names."""
    system = System(arm_model(arm), gains, settings.contact_stiffness, settings.knot_duration / settings.substeps)
    arguments = (system, settings.horizon, settings.substeps, settings.contact_measure)
    posture = None
    if settings.null_space == "reference_posture":
        posture = single(np.array(settings.resolve(arm).reference_posture)[:, None])
    if settings.pipeline == "closed_loop":
        return Objective(*arguments, posture=posture)
    # Brax's own pipeline is for comparison, and slow to import.
    from contact_reach_ros.planning.transfer.brax_generalized import BraxObjective

    return BraxObjective(*arguments, arm, posture=posture)


def knot_bounds(arm: Arm, settings: PlanningSettings) -> Array:
    """γ of an action, Δx and Δq, (6 + n,), m and rad."""
    translation, rotation = [settings.translation_bound] * 3, [settings.rotation_bound] * 3
    return np.array(translation + rotation + [settings.posture_bound] * arm.n)


def planned(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> NDArray[np.bool_]:
    """Which components of an action are variables of the plan, (6 + n,); the others are zero.

    The rows of Δx that law (1) controls; and Δq, unless it has no effect: under law (6), or where no joint is left to
    the null space.
    """
    is_planned = np.zeros(N_TASK + arm.n, bool)
    is_planned[: gains.rows] = True
    is_planned[N_TASK:] = settings.null_space == "planned" and arm.n > gains.rows
    return is_planned


def action_bounds(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> Array:
    """γ of all variables of a plan, knot after knot, (H * their number,), m and rad."""
    return np.tile(knot_bounds(arm, settings)[planned(arm, settings, gains)], settings.horizon)


class ReferenceSpace:
    """Decision variables of a plan: Δx and Δq of each knot, without the components that have no effect.

    The solver searches points (N, B) in units of the bounds, within [-1, 1].

    Attributes
    ----------
    objective
        Cost of actions.
    bounds
        (N,) γ of the variables, knot after knot, m and rad.
    vectors
        Number of vectors of variables in a plan, one after the other in time.
    """

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        self.objective = make_objective(arm, settings, gains)
        self.bounds = action_bounds(arm, settings, gains)
        self.vectors = settings.horizon
        self._planned = np.flatnonzero(planned(arm, settings, gains))

    def actions(self, points: jax.Array, problem: Problem) -> jax.Array:
        """Actions (H, 6 + n, B) of points (N, B), with zeros for the components that points leave out."""
        actions = points * self.bounds[:, None] * problem.speed_scale
        actions = actions.reshape(self.objective.horizon, -1, points.shape[1])
        missing = self.objective.system.action_size - actions.shape[1]
        if self._planned[-1] < len(self._planned):
            return jnp.pad(actions, ((0, 0), (0, missing), (0, 0)))
        whole = jnp.zeros((len(actions), self.objective.system.action_size, points.shape[1]), actions.dtype)
        return whole.at[:, self._planned].set(actions)

    def cost(self, problem: Problem, points: jax.Array) -> jax.Array:
        """Cost (B,) of points (N, B), for the solver to minimise."""
        return self.objective.cost(problem, self.actions(points, problem))


def initial_spread(settings: PlanningSettings, bounds: Array) -> Array:
    """Standard deviations (N,) of a fresh search, as shares of the bounds (N,)."""
    if settings.sampling == "bounds":
        return np.full_like(bounds, settings.sigma)
    return _PAPER_SIGMA / bounds
