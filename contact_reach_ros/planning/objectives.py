"""From the planner's settings to the function that the solver minimises."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, Problem
from contact_reach_ros.planning.problem import Array
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import default_arm
from contact_reach_ros.planning.transfer.pipeline import N_ACTION, System
from contact_reach_ros.robot import iiwa14


def make_objective(settings: PlanningSettings, gains: ImpedanceSettings) -> Objective:
    """The cost over the transfer function that `settings.pipeline` names."""
    system = System(default_arm(), gains, settings.contact_stiffness, settings.knot_duration / settings.substeps)
    arguments = (system, settings.horizon, settings.substeps, settings.contact_measure)
    posture = None if settings.null_space == "planned" else single(np.array(settings.reference_posture)[:, None])
    if settings.pipeline == "closed_loop":
        return Objective(*arguments, posture=posture)
    # Brax's own pipelines are for comparison, and take long to import.
    from contact_reach_ros.planning.transfer.brax_pipelines import STEPS, BraxObjective

    return BraxObjective(*arguments, settings.pipeline, STEPS[settings.pipeline], posture=posture)


def action_bounds(settings: PlanningSettings) -> Array:
    """γ of all variables of a plan, knot after knot; m and rad.

    (H * 13,) with Δx and Δq, or (H * 6,) with Δx alone under law (6).
    """
    knot = [settings.translation_bound] * 3 + [settings.rotation_bound] * 3
    if settings.null_space == "planned":
        knot += [settings.posture_bound] * iiwa14.N_JOINTS
    return np.tile(knot, settings.horizon)


def scaled_cost(objective: Objective, bounds: Array) -> Callable[[Problem, jax.Array], jax.Array]:
    """Cost (B,) of points (n, B) in units of the bounds (n,), which is what the solver searches."""

    def cost(problem: Problem, points: jax.Array) -> jax.Array:
        return objective.cost(problem, actions_of(points, bounds, objective.horizon))

    return cost


def actions_of(points: jax.Array, bounds: Array, horizon: int) -> jax.Array:
    """Actions (H, at least 13, B) of points (n, B) in units of the bounds (n,), filled up with zeros."""
    actions = (points * bounds[:, None]).reshape(horizon, len(bounds) // horizon, -1)
    return jnp.pad(actions, ((0, 0), (0, max(0, N_ACTION - actions.shape[1])), (0, 0)))
