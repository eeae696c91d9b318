"""What the authors' code has in its cost (5) in place of our terms of goal and contact."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Context, term
from contact_reach_ros.planning.transfer.arithmetic import dot, sum_over
from contact_reach_ros.settings import setting


@term("terminal_weight")
def terminal(context: Context) -> jax.Array:
    """Distance of the flange from the goal at the end of the plan, m; none on a detour, as of the term `goal`."""
    offset = context.position[:, -1] - context.goal_position[:, -1]
    distance = jnp.sqrt(dot(offset, offset) + 1e-8)
    if context.problem.detour is None:
        return distance
    return jnp.where(context.problem.weights["detour"] > 0.0, 0.0, distance)


@term("contact_squared_weight")
def contact_squared(context: Context) -> jax.Array:
    """Squared contact forces of all links, N²."""
    force = jnp.moveaxis(context.rollout.link_force, 1, 0)
    return sum_over(force * force, 0)


@dataclass(frozen=True)
class AuthorsSettings(PlanningSettings):
    """Settings of the planner with the weights of these terms."""

    terminal_weight: float = setting(
        0.0, "distance to the goal at the end of the plan", unit="1/m", minimum=0.0, maximum=1000.0
    )
    contact_squared_weight: float = setting(
        0.0, "squared contact forces of all links", unit="1/N²", minimum=0.0, maximum=100.0
    )
