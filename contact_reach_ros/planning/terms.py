"""The terms of the cost (5).

A term is a function of the predicted motion with the decorator `term`, or `reward` if more of it is better. Its weight
is the planner's setting `<name>_weight`. The cost is the weighted sum, over the knots, of all terms for which the
settings have a weight.

The paper's (5) is read as follows. The constraint (4d) is contact ≤ ε, so its penalty is λ3 max(0, contact − ε). The
literal λ3 (contact − ε) charges every newton, also below ε; preset `paper_linear` has it as a weight on any contact. A
small one keeps permitted forces low. The joints' limits of position and speed, absent from (5), are soft costs, as
are a goal's orientation and the null-space motion, which nothing else would restrain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from contact_reach_ros.control.settings import AXIS, POSE
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.problem import Number, Problem, Rollout
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.clearance import intrusion
from contact_reach_ros.planning.transfer.closed_loop import N_TASK
from contact_reach_ros.planning.transfer.lanes import dot, make_keep, sum_over
from contact_reach_ros.planning.transfer.model import ArmModel

ROUNDING = 0.03
"""Rotation error below which its cost is rounded off, rad.

A goal that holds the orientation starts at zero error, where a plain norm has a kink: gradient steps would get stuck
there, and the search would need three times as many solver steps.
"""


@dataclass(frozen=True, eq=False)
class Context:
    """Inputs of a term."""

    arm: ArmModel
    knot_duration: Number
    """s."""
    problem: Problem
    actions: jax.Array
    """(H, 6 + n, B)."""
    rollout: Rollout
    lead: jax.Array | None = None
    """(3, B) lead of x_d before the first knot, m; None for that of the problem's reference before."""
    task: str = POSE
    """What law (1) controls."""

    @property
    def position(self) -> jax.Array:
        """(3, H + 1, B) flange at the knot boundaries, m."""
        return jnp.moveaxis(self.rollout.pose.position, 1, 0)

    @property
    def q(self) -> jax.Array:
        """(n, H + 1, B) joint angles at the knot boundaries, rad."""
        return jnp.moveaxis(self.rollout.q, 1, 0)


Term = Callable[[Context], jax.Array]
"""Returns (H, B), to be summed over the knots, or (B,)."""

TERMS: dict[str, Term] = {}
"""Terms by name, in the order of their definition."""


REWARDS: set[str] = set()
"""Names of the terms that lower the cost."""


def term(function: Term) -> Term:
    """Add a function to the terms, under its own name."""
    TERMS[function.__name__] = function
    return function


def reward(function: Term) -> Term:
    """Add a function to the terms as one that lowers the cost."""
    REWARDS.add(function.__name__)
    return term(function)


def term_weights(settings: PlanningSettings) -> dict[str, Number]:
    """Weight of each term that counts with these settings: those that have a weight in them.

    Raises
    ------
    SettingsError
        If the settings add a weight and there is no term for it.
    """
    added = {entry.name for entry in settings.declared()} - {entry.name for entry in PlanningSettings.declared()}
    for name in sorted(added):
        if name.endswith("_weight") and name.removesuffix("_weight") not in TERMS:
            term = name.removesuffix("_weight")
            raise SettingsError(f"{type(settings).__name__}.{name}: expected a cost term named {term}, with @term")
    weights = {name: getattr(settings, f"{name}_weight") for name in TERMS if hasattr(settings, f"{name}_weight")}
    if settings.clearance_weight == 0.0:
        # Its program then does without the term.
        del weights["clearance"]
    if not settings.takes_detours:
        del weights["detour"]
    return weights


def weighted_terms(context: Context) -> dict[str, jax.Array]:
    """The terms (B,) that add up to the cost, for each weight of the problem."""
    parts = {}
    weights = context.problem.weights
    # Sums are rounded in the order of the terms, which the weights lose inside of JAX.
    for name in (name for name in TERMS if name in weights):
        part = (-weights[name] if name in REWARDS else weights[name]) * TERMS[name](context)
        parts[name] = sum_over(part, 0) if part.ndim == 2 else part
    return parts


@term
def goal(context: Context) -> jax.Array:
    """Distance of the flange from the goal, m."""
    return _length(context.position[:, 1:] - context.problem.goal_position[:, None])


@reward
def progress(context: Context) -> jax.Array:
    """Distance of the flange from where the plan starts, m."""
    return _length(context.position[:, 1:] - context.position[:, :1])


@term
def contact_limit(context: Context) -> jax.Array:
    """Contact force above the permitted one, N."""
    return jnp.maximum(context.rollout.contact - context.problem.permitted_force, 0.0)


@term
def contact(context: Context) -> jax.Array:
    """Contact force, N."""
    return context.rollout.contact


@term
def orientation(context: Context) -> jax.Array:
    """Rotation error to the goal, rad: ‖R − R_g‖ / √2 = 2 sin(angle / 2), which still grows at 180°.

    Where law (1) controls no more, it is that of the z axis: ‖z − z_g‖.
    """
    error = jnp.moveaxis(context.rollout.pose.rotation[1:] - context.problem.goal_rotation, (1, 2), (0, 1))
    square = (error[:, 2] ** 2).sum(axis=0) if context.task == AXIS else 0.5 * (error**2).sum(axis=(0, 1))
    return jnp.sqrt(square + ROUNDING**2) - ROUNDING


@term
def detour(context: Context) -> jax.Array:
    """Distance of the joints from the posture of a detour, rad."""
    posture = context.problem.detour
    if posture is None:
        return jnp.zeros_like(context.rollout.contact)
    error = context.q[:, 1:] - posture[:, None]
    return jnp.sqrt(sum_over(error * error, 0) + 1e-6)


@term
def joint_limit(context: Context) -> jax.Array:
    """Squared intrusion of the joints into the margin of their position limits, rad²."""
    q, arm = context.q[:, 1:], context.arm
    beyond = jnp.maximum(q - arm.upper[:, None, None], arm.lower[:, None, None] - q)
    intrusion = jnp.maximum(beyond + context.problem.joint_limit_margin, 0.0)
    return sum_over(intrusion * intrusion, 0)


@term
def joint_speed(context: Context) -> jax.Array:
    """Squared excess of the joints' mean speeds over their limits, rad²/s²."""
    speed = jnp.abs(context.q[:, 1:] - context.q[:, :-1]) / context.knot_duration
    excess = jnp.maximum(speed - context.arm.velocity_limit[:, None, None], 0.0)
    return sum_over(excess * excess, 0)


@term
def null_motion(context: Context) -> jax.Array:
    """Squared Δq, rad²."""
    motion = jnp.moveaxis(context.actions[:, N_TASK:], 1, 0)
    return sum_over(motion * motion, 0)


@term
def lead_change(context: Context) -> jax.Array:
    """Squared change of x_d's lead over the flange from knot to knot, and from the reference before, m²."""
    lead = jnp.moveaxis(context.actions[:, :3], 1, 0)
    before = context.problem.before
    first = lead[:, :1] if context.lead is None else context.lead[:, None]
    if context.lead is None and before is not None:
        # Where the arm is half a ramp after the start.
        start, ahead = context.position[:, 0], context.rollout.reference.position[0] - context.actions[0, :3]
        first = (before.position - start + ahead - start)[:, None]
    change = lead - jnp.concatenate([first, lead[:, :-1]], axis=1)
    return sum_over(change * change, 0)


@term
def clearance(context: Context) -> jax.Array:
    """Squared intrusion into the margin around rigid bodies and the arm's own links at the ends of the knots, m²."""
    problem, capsules = context.problem, context.rollout.capsules
    if capsules is None:
        return jnp.zeros_like(context.rollout.contact)
    keep = make_keep(capsules.start)
    return intrusion(context.arm, capsules, problem.bodies, problem.clearance_margin, keep)


def _length(vectors: jax.Array) -> jax.Array:
    """Euclidean norm along the first axis, smooth at zero."""
    return jnp.sqrt(dot(vectors, vectors) + 1e-8)
