"""The cost (5) of a plan: actions rolled out in the transfer model, and the decision variables that they stand for."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.kinematics import AXIS, link_frames_of_many, task_jacobians
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.settings import BOUNDS, POSTURE_BOUND, ROTATION_BOUND, PlanningSettings
from contact_reach_ros.planning.terms import Context, Number, Problem, Rollout, weighted_terms
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.arithmetic import collect, dot, rotate
from contact_reach_ros.planning.transfer.dynamics import Capsules, link_frames, place_capsules
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.planning.transfer.pipeline import N_TASK, Pose, Reference, System

Step = Callable[[Any, Reference], Any]
Carry = tuple[Any, Pose, Reference | None]


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost (5) over H knots of a system in closed loop.

    Another transfer function T is a subclass that overrides `transfer`; the terms depend on nothing else of it.
    """

    system: System
    """Its time step is the knot duration divided by `substeps`."""
    horizon: int
    substeps: int

    def cost(self, problem: Problem, actions: jax.Array) -> jax.Array:
        """Cost (B,) of the actions (H, 6 + n, B)."""
        return sum(self.terms(problem, actions, self.roll_out(problem, actions)).values(), start=jnp.zeros(()))

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run the transfer model under the actions (H, 6 + n, B), knot by knot."""
        return self.run(problem, actions)[1]

    def run(self, problem: Problem, actions: jax.Array) -> tuple[Carry, Rollout]:
        """As `roll_out`, with what the last knot leaves to one after it."""
        start, step = self.transfer(problem, actions.shape[-1])
        pose = pipeline.tip_pose(self.system, start.q)
        carry = start, pose, self.before(problem, start.q, pose)
        end, (q, poses, reference, link_force, contact, capsules) = jax.lax.scan(
            functools.partial(self.knot, step), carry, actions
        )
        return end, Rollout(
            q=jnp.concatenate([start.q[None], q]),
            pose=jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), pose, poses),
            reference=reference,
            link_force=link_force,
            contact=contact,
            capsules=jax.tree.map(
                lambda first, rest: jnp.concatenate([first[None], rest]), self.end_of_knot(start.q)[1], capsules
            ),
        )

    def transfer(self, problem: Problem, lanes: int) -> tuple[Any, Step]:
        """The state that a problem starts from, in each lane, and what advances it by a step under a reference.

        A state has at least `q`, `qd` and `link_force` of `pipeline.State`.
        """
        obstacles = problem.obstacles
        if obstacles is not None:
            # Only the centres, which move, need one array per lane.
            obstacles = obstacles._replace(center=_spread(obstacles.center, lanes))
        start = pipeline.init(self.system, _spread(problem.q, lanes), _spread(problem.v, lanes), obstacles)
        return start, functools.partial(pipeline.step, self.system)

    def knot(self, step: Step, carry: Carry, action: jax.Array) -> tuple[Carry, tuple]:
        """The end of a knot under an action (6 + n, B), and what a `Rollout` has of the knot.

        `carry` has the state, the pose and the reference in force.
        """
        state, pose, before = carry
        reference = self.latch(state.q, state.qd, pose, action)

        def substep(state: Any, share: jax.Array | None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            state = step(state, on_the_way(before, reference, share))
            return state, (state.link_force, state.link_force.max(axis=0))

        state, (link_force, contact) = jax.lax.scan(substep, state, self.shares(), length=self.substeps)
        pose, capsules = self.end_of_knot(state.q)
        reached = None
        if before is not None:
            way = min(1.0, self.substeps * float(self.system.timestep) / self.ramp)
            reached = reference if way == 1.0 else on_the_way(before, reference, way)
        return (state, pose, reached), (state.q, pose, reference, link_force.max(axis=0), contact.max(axis=0), capsules)

    @property
    def ramp(self) -> float:
        """Time in which the reference moves to that of a knot, s; 0 if it steps."""
        return self.system.gains.reference_ramp

    def before(self, problem: Problem, q: jax.Array, pose: Pose) -> Reference | None:
        """The reference from which the first knot's is approached; None if it steps.

        Unless the problem has one, it holds the arm at `q` (n, B), where the flange has this pose.
        """
        if not self.ramp:
            return None
        if problem.before is None:
            return Reference(pose.position, pose.rotation, q)
        return jax.tree.map(lambda array: _spread(array, q.shape[-1]), problem.before)

    def shares(self) -> jax.Array | None:
        """How far the reference has moved, in the mean over each step of a knot, (substeps,); None if it steps."""
        if not self.ramp:
            return None
        ends = np.arange(self.substeps + 1) * float(self.system.timestep) / self.ramp
        integrals = np.where(ends < 1.0, 0.5 * ends**2, ends - 0.5)
        return jnp.asarray(np.diff(integrals) / ends[1], jnp.float32)

    def end_of_knot(self, q: jax.Array) -> tuple[Pose, Capsules]:
        """Flange pose and capsules at joint angles `q` (n, B)."""
        frames = link_frames(self.system.arm, q)
        return Pose(frames.flange, frames.flange_rotation), place_capsules(self.system.arm, frames)

    def terms(self, problem: Problem, actions: jax.Array, rollout: Rollout) -> dict[str, jax.Array]:
        """The weighted terms (B,) that add up to the cost, each summed over the horizon."""
        duration = self.system.timestep * self.substeps
        return weighted_terms(
            Context(self.system.arm, duration, problem, actions, rollout, task=self.system.gains.task)
        )

    def latch(self, q: jax.Array, v: jax.Array, pose: Pose, action: jax.Array) -> Reference:
        """The reference x_d = x ⊕ Δx, q_d = q + Δq that an action {Δx, Δq} (6 + n, B) stands for.

        It is taken at joint angles `q` (n, B), where the flange has this pose. One that moves lags behind by half of
        its ramp: it is that of where the arm will be by then at speeds `v` (n, B).

        Δx is a translation in m and a rotation vector in rad in base axes, Δq is in rad. Where law (1) controls the
        direction of the flange's z axis only, the rotation vector is in the flange's axes, and its last component stays
        zero.
        """
        if self.ramp:
            q = q + 0.5 * self.ramp * v
            pose = pipeline.tip_pose(self.system, q)
        turn = action[3:N_TASK]
        if self.system.gains.task == AXIS:
            turn = jnp.stack([dot(row, turn) for row in pose.rotation])
        return Reference(pose.position + action[:3], rotate(turn, pose.rotation), q + action[N_TASK:])


def on_the_way(before: Reference | None, reference: Reference, share: Number | None) -> Reference:
    """The reference at a share of the way from the one before; rotations are as close as needed for small turns."""
    if before is None or share is None:
        return reference
    return jax.tree.map(lambda start, end: start + share * (end - start), before, reference)


def _spread(array: jax.Array, lanes: int) -> jax.Array:
    return jnp.broadcast_to(array, (*array.shape[:-1], lanes))


SIGMA = 0.15
"""Standard deviation of every variable when a search begins, as a share of its bound: few candidates lie outside."""
PAPER_SIGMA = 0.01
"""Standard deviation of every variable, m or rad, in line 1 of Algorithm 1."""


def make_objective(arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> Objective:
    """The cost over the transfer function that `settings.pipeline` names."""
    timestep = settings.knot_duration / settings.substeps
    system = System(arm_model(arm), gains.resolve(arm), timestep)
    arguments = (system, settings.horizon, settings.substeps)
    if settings.pipeline == "closed_loop":
        return Objective(*arguments)
    # Brax's own pipeline is for comparison, and slow to import.
    from contact_reach_ros.planning.brax_env import BraxObjective

    return BraxObjective(*arguments, arm)


def knot_bounds(arm: Arm, settings: PlanningSettings) -> Array:
    """γ of an action, Δx and Δq, (6 + n,), m and rad."""
    translation, rotation = [settings.translation_bound] * 3, [ROTATION_BOUND] * 3
    return np.array(translation + rotation + [POSTURE_BOUND] * arm.n)


class ReferenceSpace:
    """Decision variables of a plan: of each knot, the rows of Δx that law (1) controls, and Δq.

    Δq is left out where no joint is left to the null space. The solver searches points (N, B) in units of the bounds,
    within [-1, 1].

    Attributes
    ----------
    objective
        Cost of actions.
    bounds
        (N,) γ of the variables, knot after knot, m and rad.
    spread
        (N,) standard deviations of the variables when a search begins, as shares of the bounds.
    vectors
        Number of vectors of variables in a plan, one after the other in time.
    """

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        self.objective, self._arm = make_objective(arm, settings, gains), arm
        rows = self.objective.system.gains.rows
        moves_posture = arm.n > rows
        self._planned = np.r_[:rows, N_TASK : N_TASK + moves_posture * arm.n]
        self.bounds = np.tile(knot_bounds(arm, settings)[self._planned], settings.horizon)
        self.spread = np.full_like(self.bounds, SIGMA) if settings.sampling == BOUNDS else PAPER_SIGMA / self.bounds
        self.vectors = settings.horizon

    def actions(self, points: jax.Array, problem: Problem) -> jax.Array:
        """Actions (H, 6 + n, B) of points (N, B), with zeros for the components that points leave out."""
        actions = points * self.bounds[:, None] * problem.speed_scale
        actions = actions.reshape(self.objective.horizon, -1, points.shape[1])
        return collect(actions, self._planned, self.objective.system.action_size)

    def towards(self, q: Array, posture: Array) -> Array:
        """The point (N,) whose actions all lead straight through joint space from `q` to a posture, (n,) each, rad."""
        frames, origins = link_frames_of_many(self._arm, q[None])
        (jacobian,) = task_jacobians(frames, origins, self.objective.system.gains.task)
        action = np.concatenate([jacobian, np.eye(self._arm.n)]) @ (posture - q)
        point = action[: len(self.bounds) // self.vectors] / self.bounds[: len(self.bounds) // self.vectors]
        return np.tile(point / max(1.0, np.abs(point).max()), self.vectors)

    def cost(self, problem: Problem, points: jax.Array) -> jax.Array:
        """Cost (B,) of points (N, B), for the solver to minimise."""
        return self.objective.cost(problem, self.actions(points, problem))
