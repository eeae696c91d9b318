"""The cost (5): the transfer model rolled out under the actions of a plan, and what is thought of the outcome.

The paper's (5) is read as follows. The constraint (4d) is contact ≤ ε, so its penalty is λ3 max(0, contact − ε) and not
the literal λ3 (contact − ε), which would reward every newton below ε as much as it punishes one above. A small weight
on any contact keeps permitted forces low. The joints' limits of position and speed, absent from (5), are soft costs; so
are a goal's orientation and the null-space motion, which nothing else would restrain.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp

from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import dot, sum_over
from contact_reach_ros.planning.transfer.pipeline import Pose, Reference, State, System

ROUNDING = 0.03
"""Rotation error below which its cost is rounded off, rad.

A goal that holds the orientation starts at zero error, where a plain norm has a kink: gradient steps would be stuck in
it, and three times as many solver steps be needed.
"""


Number = float | jax.Array


class Weights(NamedTuple):
    """The numbers of the cost; inputs of the compiled program, so that a change does not compile it again."""

    goal: Number
    progress: Number
    contact_limit: Number
    permitted_force: Number
    contact: Number
    orientation: Number
    joint_limit: Number
    joint_limit_margin: Number
    joint_speed: Number
    null_motion: Number

    @classmethod
    def of(cls, settings: PlanningSettings, permitted_force: float) -> Weights:
        """The weights of the settings and ε in N."""
        return cls(
            goal=settings.goal_weight,
            progress=settings.progress_weight,
            contact_limit=settings.contact_limit_weight,
            permitted_force=permitted_force,
            contact=settings.contact_weight,
            orientation=settings.orientation_weight,
            joint_limit=settings.joint_limit_weight,
            joint_limit_margin=settings.joint_limit_margin,
            joint_speed=settings.joint_speed_weight,
            null_motion=settings.null_motion_weight,
        )


class Problem(NamedTuple):
    """One planning problem: all inputs of the compiled program."""

    q: jax.Array
    """(7, 1) joint angles when the plan takes effect, rad."""
    v: jax.Array
    """(7, 1), rad/s."""
    obstacles: Obstacles | None
    """With one lane, or None for a program without contact."""
    goal_position: jax.Array
    """(3, 1), m."""
    goal_rotation: jax.Array
    """(3, 3, 1); any rotation if the orientation is free, and then weights.orientation is zero."""
    weights: Weights


class Rollout(NamedTuple):
    """What the transfer model expects of the actions."""

    q: jax.Array
    """(H + 1, 7, B) joint angles at the knot boundaries, rad."""
    pose: Pose
    """(H + 1, ...) flange at the knot boundaries."""
    reference: Reference
    """(H, ...) what the actions stand for."""
    link_force: jax.Array
    """(H, 6, B) largest force within each knot on each capsule, N."""
    contact: jax.Array
    """(H, B) contact(·) of (4d): largest value within each knot, N."""


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost (5) over H knots of a system in closed loop.

    Another transfer function T is a subclass that overrides `roll_out`, and `integration_steps` if it takes more of
    them; the cost sees nothing else of it.
    """

    system: System
    """Its time step is the knot duration divided by `substeps`."""
    horizon: int
    substeps: int
    contact_measure: str
    posture: jax.Array | None = field(default=None, kw_only=True)
    """(7, 1) q_d of law (6), or None to pull the joints by the actions' Δq."""

    @property
    def integration_steps(self) -> int:
        """Steps that the transfer model takes over the horizon."""
        return self.horizon * self.substeps

    def cost(self, problem: Problem, actions: jax.Array) -> jax.Array:
        """Cost (B,) of the actions (H, 13, B)."""
        return sum(self.terms(problem, actions, self.roll_out(problem, actions)).values(), start=jnp.zeros(()))

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run the transfer model under the actions (H, 13, B), knot by knot."""
        start = self.start(problem, actions.shape[-1])
        pose = pipeline.flange_pose(self.system, start)

        def knot(carry: tuple[State, Pose], action: jax.Array) -> tuple[tuple[State, Pose], tuple]:
            state, pose = carry
            reference = self._latch(state.q, pose, action)

            def substep(state: State, _: None) -> tuple[State, tuple[jax.Array, jax.Array]]:
                state = pipeline.step(self.system, state, reference)
                return state, (state.link_force, self._measure(state.link_force))

            state, (link_force, contact) = jax.lax.scan(substep, state, None, length=self.substeps)
            pose = pipeline.flange_pose(self.system, state)
            return (state, pose), (state.q, pose, reference, link_force.max(axis=0), contact.max(axis=0))

        _, (q, poses, reference, link_force, contact) = jax.lax.scan(knot, (start, pose), actions)
        return Rollout(
            q=jnp.concatenate([start.q[None], q]),
            pose=jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), pose, poses),
            reference=reference,
            link_force=link_force,
            contact=contact,
        )

    def start(self, problem: Problem, lanes: int) -> State:
        """The state that a problem starts from, in each lane."""
        return pipeline.init(
            self.system, _spread(problem.q, lanes), _spread(problem.v, lanes), _obstacles(problem.obstacles, lanes)
        )

    def terms(self, problem: Problem, actions: jax.Array, rollout: Rollout) -> dict[str, jax.Array]:
        """The parts (B,) that add up to the cost, each summed over the horizon."""
        weights = problem.weights
        q = jnp.moveaxis(rollout.q[1:], 1, 0)
        position = jnp.moveaxis(rollout.pose.position, 1, 0)
        to_goal = _length(position[:, 1:] - problem.goal_position[:, None])
        from_start = _length(position[:, 1:] - position[:, :1])
        misalignment = jnp.moveaxis(rollout.pose.rotation[1:] - problem.goal_rotation, (1, 2), (0, 1))
        # ‖R − R_g‖ / √2 is 2 sin(angle / 2): the angle while it is small, and still growing at 180°.
        turned = jnp.sqrt(0.5 * (misalignment**2).sum(axis=(0, 1)) + ROUNDING**2) - ROUNDING
        limit = self.system.arm.position_limit[:, None, None]
        intrusion = jnp.maximum(jnp.abs(q) - limit + weights.joint_limit_margin, 0.0)
        excess = jnp.maximum(rollout.contact - weights.permitted_force, 0.0)
        speed = jnp.abs(q - jnp.moveaxis(rollout.q[:-1], 1, 0)) / (self.system.timestep * self.substeps)
        speeding = jnp.maximum(speed - self.system.arm.velocity_limit[:, None, None], 0.0)
        null_motion = jnp.moveaxis(actions[:, 6:], 1, 0)
        parts = {
            "goal": weights.goal * to_goal,
            "progress": -weights.progress * from_start,
            "contact_limit": weights.contact_limit * excess,
            "contact": weights.contact * rollout.contact,
            "orientation": weights.orientation * turned,
            "joint_limit": weights.joint_limit * sum_over(intrusion * intrusion, 0),
            "joint_speed": weights.joint_speed * sum_over(speeding * speeding, 0),
            "null_motion": weights.null_motion * sum_over(null_motion * null_motion, 0),
        }
        return {name: sum_over(part, 0) for name, part in parts.items()}

    def _latch(self, q: jax.Array, pose: Pose, action: jax.Array) -> Reference:
        """What an action (13, B) stands for at the joint angles `q` (7, B)."""
        reference = pipeline.latch(q, pose, action)
        if self.posture is None:
            return reference
        return reference._replace(posture=_spread(self.posture, action.shape[-1]))

    def _measure(self, link_force: jax.Array) -> jax.Array:
        """contact(·) (B,) of the forces (6, B) on the links."""
        return link_force.max(axis=0) if self.contact_measure == "largest" else sum_over(link_force, 0)


def _length(vectors: jax.Array) -> jax.Array:
    """Euclidean norm along the first axis, smooth at zero."""
    return jnp.sqrt(dot(vectors, vectors) + 1e-8)


def _spread(array: jax.Array, lanes: int) -> jax.Array:
    return jnp.broadcast_to(array, (*array.shape[:-1], lanes))


def _obstacles(obstacles: Obstacles | None, lanes: int) -> Obstacles | None:
    """The same obstacles in every lane; only the centres, which move, need an array per lane."""
    return None if obstacles is None else obstacles._replace(center=_spread(obstacles.center, lanes))
