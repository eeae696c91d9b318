"""From the planner's settings to the function that the solver minimises."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, Problem
from contact_reach_ros.planning.problem import Array
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.model import default_arm
from contact_reach_ros.planning.transfer.pipeline import N_ACTION, System


def make_objective(settings: PlanningSettings, gains: ImpedanceSettings) -> Objective:
    """The cost over the transfer function that `settings.pipeline` names."""
    system = System(default_arm(), gains, settings.contact_stiffness, settings.knot_duration / settings.substeps)
    arguments = (system, settings.horizon, settings.substeps, settings.contact_measure)
    if settings.pipeline == "closed_loop":
        return Objective(*arguments)
    # Brax's own pipelines are for comparison, and take long to import.
    from contact_reach_ros.planning.transfer.brax_pipelines import STEPS, BraxObjective

    return BraxObjective(*arguments, settings.pipeline, STEPS[settings.pipeline])


def action_bounds(settings: PlanningSettings) -> Array:
    """γ of all variables of a plan, (H * 13,), knot after knot; m and rad."""
    knot = [settings.translation_bound] * 3 + [settings.rotation_bound] * 3 + [settings.posture_bound] * 7
    return np.tile(knot, settings.horizon)


def scaled_cost(objective: Objective, bounds: Array) -> Callable[[Problem, jax.Array], jax.Array]:
    """Cost (B,) of points (n, B) in units of the bounds (n,), which is what the solver searches."""

    def cost(problem: Problem, points: jax.Array) -> jax.Array:
        return objective.cost(problem, actions_of(points, bounds))

    return cost


def actions_of(points: jax.Array, bounds: Array) -> jax.Array:
    """Actions (H, 13, B) of points (n, B) in units of the bounds (n,)."""
    return (points * bounds[:, None]).reshape(len(bounds) // N_ACTION, N_ACTION, -1)
