"""The cost (5): planning problems, the motion predicted for them, and the terms of their cost.

A term is a function of the predicted motion with the decorator `term`, which names the planner's setting that holds its
weight, or has the weight itself. The cost is the weighted sum, over the knots, of all terms for which the settings have
a weight.

The paper's (5) is read as follows. The constraint (4d) is contact ≤ ε, so its penalty is λ3 max(0, contact − ε). The
literal λ3 (contact − ε) charges every newton, also below ε; preset `paper_linear` has it as a weight on any contact. A
small one keeps permitted forces low. The joints' limits of position and speed, absent from (5), are soft costs, as
are a goal's orientation and the null-space motion, which nothing else would restrain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.arm.kinematics import AXIS, POSE
from contact_reach_ros.control.settings import IMPACT_ENERGY, LimitSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.observer import EXCESS_FORCE
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.arithmetic import dot, sum_over
from contact_reach_ros.planning.transfer.clearance import Bodies, intrusions
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.dynamics import Capsules
from contact_reach_ros.planning.transfer.model import ArmModel
from contact_reach_ros.planning.transfer.pipeline import N_TASK, Pose, Reference
from contact_reach_ros.world.goal import Target

Number = float | jax.Array


class Problem(NamedTuple):
    """One planning problem. All of it is input of the compiled programs: other numbers need no recompilation."""

    q: jax.Array
    """(n, 1) joint angles when the plan takes effect, rad."""
    v: jax.Array
    """(n, 1), rad/s."""
    obstacles: Obstacles | None
    """Obstacles with one lane, or None for a program without contact."""
    goal_position: jax.Array
    """(3, 1) when the plan takes effect, m."""
    goal_rotation: jax.Array
    """(3, 3, 1); any rotation if the orientation is free, which makes the weight of the term `orientation` zero."""
    weights: dict[str, Number]
    """Weight of each term of the cost, by the term's name."""
    permitted_force: Number
    """ε of (4d), N."""
    bodies: Bodies | None = None
    """Rigid bodies; None for a program that knows the arm's own capsules only."""
    speed_scale: Number = 1.0
    """Share of γ that bounds the actions."""
    body_speed: Number = LimitSettings().body_speed
    """Speed of any point of the arm beyond which the controller does not drive it, m/s."""
    before: Reference | None = None
    """The reference in force when the plan takes effect, with one lane; None where the arm is held at `q`."""
    detour: jax.Array | None = None
    """(n, 1) posture of the detour, rad, which counts if the term `detour` has a weight."""
    goal_velocity: Number | Array = np.zeros((3, 1), np.float32)
    """(3, 1), m/s."""


class Rollout(NamedTuple):
    """Motion that the transfer model predicts for some actions."""

    q: jax.Array
    """(H + 1, n, B) joint angles at the knot boundaries, rad."""
    pose: Pose
    """(H + 1, ...) flange at the knot boundaries."""
    reference: Reference
    """(H, ...) references that the actions stand for."""
    link_force: jax.Array
    """(H, L, B) largest force within each knot on each of the arm's `contact_links`, N."""
    contact: jax.Array
    """(H, B) contact(·) of (4d): largest value within each knot, N."""
    capsules: Capsules
    """(H + 1, ...) capsules of the links at the knot boundaries."""


JOINT_LIMIT_MARGIN = 0.025
"""Distance from a joint's limit at which its cost starts, rad: plans lean against the controller's push before."""

CLEARANCE_MARGIN = 0.01
"""Distance from rigid bodies, and between the arm's own capsules, at which their cost starts, m: a step of γ."""

ROUNDING = 0.03
"""Rotation error below which its cost is rounded off, rad.

A goal that holds the orientation starts at zero error, where a plain norm has a kink: gradient steps would get stuck
there, and the search would need three times as many solver steps.
"""


_AIM = 0.7
"""Time in a knot at which a moving goal is where the tip is to be, as a share of the knot."""


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
    def goal_position(self) -> jax.Array:
        """(3, H, 1) the goal that the tip is to be at when each knot ends, m: where it is a little earlier.

        The next plan comes before a knot ends: a tip that is to be on a moving goal at the ends runs ahead of it.
        """
        problem, knots = self.problem, self.rollout.contact.shape[0]
        times = self.knot_duration * (_AIM + jnp.arange(knots, dtype=jnp.float32))
        return problem.goal_position[:, None] + jnp.asarray(problem.goal_velocity)[:, None] * times[:, None]

    @property
    def q(self) -> jax.Array:
        """(n, H + 1, B) joint angles at the knot boundaries, rad."""
        return jnp.moveaxis(self.rollout.q, 1, 0)


Value = Callable[[Context], jax.Array]
"""Returns (H, B), to be summed over the knots, or (B,)."""


class Term(NamedTuple):
    """A term of the cost."""

    value: Value
    weight: str | float
    """The setting that holds the weight, or the weight itself."""


TERMS: dict[str, Term] = {}
"""Terms by name, in the order of their definition."""


def term(weight: str | float) -> Callable[[Value], Value]:
    """Add a function to the terms, under its own name.

    Raises `SettingsError` if there is a term of this name: it would no longer count.
    """

    def add(value: Value) -> Value:
        if value.__name__ in TERMS:
            raise SettingsError(f"cost term '{value.__name__}': expected a new name; used are {', '.join(TERMS)}")
        TERMS[value.__name__] = Term(value, weight)
        return value

    return add


def term_weights(settings: PlanningSettings) -> dict[str, float]:
    """Weight of each term that counts with these settings.

    Raises
    ------
    SettingsError
        If the settings add a weight that no term has.
    """
    names = {own.weight for own in TERMS.values()}
    for entry in settings.declared():
        if entry.name.endswith("_weight") and entry.name not in names:
            where = f"{type(settings).__name__}.{entry.name}"
            raise SettingsError(f'{where}: expected a cost term with this weight, @term("{entry.name}")')
    known = vars(settings)
    return {
        name: known[own.weight] if isinstance(own.weight, str) else own.weight
        for name, own in TERMS.items()
        if not isinstance(own.weight, str) or own.weight in known
    }


def weighted_terms(context: Context) -> dict[str, jax.Array]:
    """The terms (B,) that add up to the cost, for each weight of the problem."""
    parts = {}
    weights = context.problem.weights
    _, knots, candidates = context.position[:, 1:].shape
    # Sums are rounded in the order of the terms, which the weights lose inside of JAX.
    for name in (name for name in TERMS if name in weights):
        part = weights[name] * TERMS[name].value(context)
        if part.shape not in ((knots, candidates), (candidates,)):
            raise SettingsError(
                f"cost term '{name}' returns an array {part.shape}; expected ({knots}, {candidates}), a value for each "
                f"knot and candidate, or ({candidates},)"
            )
        parts[name] = sum_over(part, 0) if part.ndim == 2 else part
    return parts


@term("goal_weight")
def goal(context: Context) -> jax.Array:
    """Distance of the flange from the goal, m."""
    return _length(context.position[:, 1:] - context.goal_position)


@term("progress_weight")
def progress(context: Context) -> jax.Array:
    """Distance of the flange from where the plan starts, m, which lowers the cost."""
    return -_length(context.position[:, 1:] - context.position[:, :1])


@term("contact_limit_weight")
def contact_limit(context: Context) -> jax.Array:
    """Contact force above the permitted one, N, on a link, or on all together if that is more than one may have."""
    rollout, permitted = context.rollout, context.problem.permitted_force
    together = sum_over(rollout.link_force, 1) - EXCESS_FORCE
    return jnp.maximum(jnp.maximum(rollout.contact, together) - permitted, 0.0)


@term("contact_weight")
def contact(context: Context) -> jax.Array:
    """Contact force, N."""
    return context.rollout.contact


@term("orientation_weight")
def orientation(context: Context) -> jax.Array:
    """Rotation error to the goal, rad: ‖R − R_g‖ / √2 = 2 sin(angle / 2), which still grows at 180°.

    Where law (1) controls no more, it is that of the z axis: ‖z − z_g‖.
    """
    error = jnp.moveaxis(context.rollout.pose.rotation[1:] - context.problem.goal_rotation, (1, 2), (0, 1))
    square = (error[:, 2] ** 2).sum(axis=0) if context.task == AXIS else 0.5 * (error**2).sum(axis=(0, 1))
    return jnp.sqrt(square + ROUNDING**2) - ROUNDING


@term(0.5)
def detour(context: Context) -> jax.Array:
    """Distance of the joints from the posture of a detour, rad; a radian costs as much as half a metre to the goal."""
    posture = context.problem.detour
    if posture is None:
        return jnp.zeros_like(context.rollout.contact)
    error = context.q[:, 1:] - posture[:, None]
    return jnp.sqrt(sum_over(error * error, 0) + 1e-6)


@term(160.0)
def joint_limit(context: Context) -> jax.Array:
    """Squared intrusion of the joints into the margin of their position limits, rad².

    Half of the margin costs as much as 25 mm to the goal: the cost holds joints off their stops, not off the margin.
    """
    q, arm = context.q[:, 1:], context.arm
    beyond = jnp.maximum(q - arm.upper[:, None, None], arm.lower[:, None, None] - q)
    intrusion = jnp.maximum(beyond + JOINT_LIMIT_MARGIN, 0.0)
    return sum_over(intrusion * intrusion, 0)


@term(0.3)
def joint_speed(context: Context) -> jax.Array:
    """Squared excess of the joints' mean speeds over half of their limits, rad²/s².

    Faster than that the laws drive joints where the arm is singular. An excess of 0.4 rad/s costs as much as 50 mm to
    the goal.
    """
    speed = jnp.abs(context.q[:, 1:] - context.q[:, :-1]) / context.knot_duration
    excess = jnp.maximum(speed - 0.5 * context.arm.velocity_limit[:, None, None], 0.0)
    return sum_over(excess * excess, 0)


@term(20.0)
def body_speed(context: Context) -> jax.Array:
    """Squared excess of the mean speeds of the capsules' ends over those that the controller drives them with, m²/s².

    Less than `body_speed` where the mass that moves with an end would hit with more than `IMPACT_ENERGY`. An excess of
    0.05 m/s costs as much as 50 mm to the goal.
    """
    capsules, excess = context.rollout.capsules, jnp.zeros(())
    by_energy = np.sqrt(2.0 * IMPACT_ENERGY / context.arm.end_mass)[:, :, None]
    for points, permitted in zip((capsules.start, capsules.start + capsules.axis), by_energy, strict=True):
        velocity = jnp.moveaxis(points[1:] - points[:-1], 1, 0) / context.knot_duration
        beyond = jnp.maximum(_length(velocity) - jnp.minimum(permitted, context.problem.body_speed), 0.0)
        excess = excess + sum_over(beyond * beyond, 1)
    return excess


@term("null_motion_weight")
def null_motion(context: Context) -> jax.Array:
    """Squared Δq, rad²."""
    motion = jnp.moveaxis(context.actions[:, N_TASK:], 1, 0)
    return sum_over(motion * motion, 0)


@term("lead_change_weight")
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


_BODIES = 5.0
"""Factor on the cost of nearness to rigid bodies: the arm's own capsules, rounder than links, may touch."""


@term(200.0)
def clearance(context: Context) -> jax.Array:
    """Squared intrusion into the margin around rigid bodies and the arm's own links at the ends of the knots, m².

    Half of the margin around a body costs as much as 25 mm to the goal.
    """
    capsules = jax.tree.map(lambda boundaries: boundaries[1:], context.rollout.capsules)
    own, others = intrusions(context.arm, capsules, context.problem.bodies, CLEARANCE_MARGIN)
    return own + _BODIES * others


def _length(vectors: jax.Array) -> jax.Array:
    """Euclidean norm along the first axis, smooth at zero."""
    return jnp.sqrt(dot(vectors, vectors) + 1e-8)


LEAST_SPEED = 0.3
"""Mean speed of approach down to which contact may slow the arm, as a share of what γ permits."""

METRES_PER_RADIAN = 0.2
"""How far from the goal the arm is for each radian of its angle to it, m."""

_LEAST_SHARE = 0.01
_ARRIVED = 0.005, 0.04
"""Distance, m, and angle, rad, within which the arm counts as arrived at the goal, not as delayed."""


class Approach(NamedTuple):
    """Progress towards a goal when a plan takes effect, and patience with permitted contact.

    The paper's constraint is contact ≤ ε; forces below are permitted, and `contact_weight` keeps them low. With that
    weight alone the arm would wait forever where the next step costs more in contact than it gains on the way: in front
    of foam slightly stiffer than the foam that the weight was chosen for, or a centimetre before a goal inside it.
    """

    position: Array
    """(3,) of the flange, m: goals may move."""
    share: float = 1.0
    """Share of the weight of permitted contact for the next plan."""
    rotation: Array | None = None
    """(3, 3) of the flange; None if it does not count."""

    def weights(self, settings: PlanningSettings) -> dict[str, float]:
        """Weights of terms for the next plan, by their names."""
        return {"contact": self.share * settings.contact_weight}

    def updated(
        self,
        position: Array,
        goal: Target,
        elapsed: float,
        patience: float,
        least_speed: float,
        is_firm: bool = False,
        rotation: Array | None = None,
    ) -> Approach:
        """Progress after some more time.

        The share falls by a factor e for every `patience` that the arm is behind. It recovers as the arm catches up, or
        by the same factor for every `patience` during which contact is firm.

        Parameters
        ----------
        position
            Present position (3,) of the flange, m.
        goal
            Where it is to be now.
        elapsed
            Time since the last progress, s.
        patience
            Time constant, s; 0 keeps the share as it is.
        least_speed
            Mean speed of approach below which the arm is behind, m/s; 0 and infinity keep the share as it is.
        is_firm
            Whether the expected contact is stronger than permitted.
        rotation
            Present rotation (3, 3) of the flange; None if it does not count.
        """
        share, distance = self.share, math.dist(position, goal.position)
        before = math.dist(self.position, goal.position)
        is_there = distance <= _ARRIVED[0]
        if rotation is not None and self.rotation is not None:
            angle = goal.angle(rotation)
            is_there = is_there and angle <= _ARRIVED[1]
            before += METRES_PER_RADIAN * (goal.angle(self.rotation) - angle)
        if patience > 0.0 and 0.0 < least_speed < math.inf and not is_there:
            ahead = (before - distance) / least_speed - elapsed
            if is_firm:
                ahead = max(ahead, elapsed)
            # The limits keep the exponential finite, whatever happened in between.
            share = min(max(share * math.exp(min(max(ahead / patience, -10.0), 10.0)), _LEAST_SHARE), 1.0)
        return Approach(position, share, rotation)
