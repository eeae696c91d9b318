"""The same problem rolled out by Brax's own pipelines, for comparison: `generalized`, `spring` and `positional`.

The arm and the obstacle spheres are bodies of a Brax system. The laws (1)-(3) are computed from its state and act on it
as joint torques. Gravity, which the laws cancel on the arm and the springs carry on the spheres, is left out. The laws
are computed for all candidates at once by this package's own fast code: the comparison is about the physics.

A sphere moves on three sliders. Springs, dampers and edges act on these as actuator forces. As in this package's own
pipeline, spheres have no mass of their own; the body that Brax moves has the mass m = dt (damping + dt stiffness), with
which Brax's explicit step becomes the implicit one of the sphere without mass.

- `generalized` knows joint coordinates, and soft contact after MuJoCo's model, with the planner's stiffness. Its solver
  takes time with the square of the constraints, for each step and candidate: only the deepest contacts count, and
  joints have no stops, as in this package's own pipeline.
- `spring` and `positional` know maximal coordinates, where a joint torque first turns one link alone, and the joints
  pass it on in later steps. The laws' damping, made for the inertia of the whole arm, would be 18,000 1/s of that link.
  So the torque is held over many steps, as that of a controller of 40 Hz, and sees the mean speed of the last ones.
  Contact is hard, an impulse or a displacement, and has no stiffness to set: only the spheres' springs give way.

Brax returns no contact forces. Here a sphere's contact force is what its spring, damper and edges need for its motion,
averaged over a step of this package's own pipeline; it is attributed to the nearest link.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
from typing import Any, NamedTuple

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax import kinematics
from brax.base import Actuator
from brax.generalized import dynamics as brax_dynamics
from brax.generalized.base import State as GeneralizedState

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, on_the_way
from contact_reach_ros.planning.problem import Problem, Rollout
from contact_reach_ros.planning.transfer.brax_maximal import in_maximal_coordinates, with_joint_springs
from contact_reach_ros.planning.transfer.brax_spheres import network, sphere_body, with_spheres
from contact_reach_ros.planning.transfer.closed_loop import Reference, joint_acceleration
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.dynamics import arm_dynamics
from contact_reach_ros.planning.transfer.kinematics import Frames, capsule_segments, flange_drift, link_frames
from contact_reach_ros.planning.transfer.lanes import collect, dot, make_keep
from contact_reach_ros.planning.transfer.model import ArmModel, load_system, read_arm
from contact_reach_ros.planning.transfer.pipeline import Pose

_TORQUES = {"generalized": 2, "spring": 1, "positional": 1}
"""Torques of the laws per step of this package's own pipeline, 25 ms at the defaults."""

_STEPS = {"generalized": 1, "spring": 500, "positional": 100}
"""Steps of Brax per torque; both are about the fewest that are stable."""

_CONTACTS = 2
"""Of each sphere, on the average: those that are deepest among all. Without a bound each capsule adds one."""


@dataclasses.dataclass(frozen=True, eq=False)
class BraxObjective(Objective):
    """Cost (5) over one of Brax's own pipelines."""

    pipeline: str
    """Its name in Brax."""
    table: Arm
    """The arm whose MJCF Brax loads, with spheres."""

    @property
    def integration_steps(self) -> int:
        """Steps of Brax over the horizon."""
        return super().integration_steps * _TORQUES[self.pipeline] * _STEPS[self.pipeline]

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run Brax under the actions (H, 6 + n, B), knot by knot."""
        lanes = actions.shape[-1]
        world = _World.of(self, problem.obstacles)
        q = jnp.broadcast_to(problem.q, (world.arm.n, lanes))
        v = jnp.broadcast_to(problem.v, (world.arm.n, lanes))
        motion = world.init(q, v)
        pose = world.pose(q)

        def knot(carry: tuple[_Motion, jax.Array, Pose, Reference | None], action: jax.Array) -> tuple[tuple, tuple]:
            motion, q, pose, before = carry
            reference = self.latch(q, motion.v, pose, action)

            def window(motion: _Motion, share: jax.Array | None) -> tuple[_Motion, jax.Array]:
                act = on_the_way(before, reference, share)
                torques = _TORQUES[self.pipeline]
                motion, forces = jax.lax.scan(lambda motion, _: world.advance(motion, act), motion, length=torques)
                return motion, world.link_force(motion.state, forces.mean(axis=0))

            motion, link_force = jax.lax.scan(window, motion, self.shares(), self.substeps)
            contact = jax.vmap(self.measure)(link_force)
            q = world.joints(motion.state)
            pose, capsules = self.end_of_knot(problem, q)
            carry = motion, q, pose, self.reached(before, reference)
            return carry, (q, pose, reference, link_force.max(axis=0), contact.max(axis=0), capsules)

        start = motion, q, pose, self.before(problem, q, pose)
        _, (later_q, poses, reference, link_force, contact, capsules) = jax.lax.scan(knot, start, actions)
        return Rollout(
            q=jnp.concatenate([q[None], later_q]),
            pose=jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), pose, poses),
            reference=reference,
            link_force=link_force,
            contact=contact,
            capsules=capsules,
        )


class _Motion(NamedTuple):
    """Where a rollout is."""

    state: Any
    """Brax's, of all candidates."""
    v: jax.Array
    """(n, B) joint speeds that the laws see, rad/s."""


class _World(NamedTuple):
    """Arm and spheres in Brax, all candidates side by side: Brax's arrays have them on the first axis."""

    pipeline: Any
    """Brax's module."""
    steps: int
    """Steps of Brax per torque of the laws."""
    system: brax.System
    arm: ArmModel
    """The arm that the laws use."""
    gains: ImpedanceSettings
    obstacles: Obstacles | None
    stiffness: jax.Array
    """(K, K) of the springs and edges, N/m."""
    mass: jax.Array
    """(K,) of the bodies that stand for the spheres, kg."""

    @classmethod
    def of(cls, objective: BraxObjective, obstacles: Obstacles | None) -> _World:
        count = 0 if obstacles is None else obstacles.radius.shape[0]
        system, arm = _load(objective.pipeline, count, objective.table)
        steps = _STEPS[objective.pipeline]
        timestep = objective.system.timestep / (_TORQUES[objective.pipeline] * steps)
        if objective.pipeline == "spring":
            system = with_joint_springs(system, arm, timestep)
        system = system.tree_replace({"opt.timestep": timestep})
        stiffness, mass = jnp.zeros((0, 0)), jnp.zeros(0)
        if obstacles is not None:
            stiffness, damping = network(obstacles)
            mass = timestep * (jnp.abs(damping).sum(axis=1) + timestep * jnp.abs(stiffness).sum(axis=1))
            system = with_spheres(system, obstacles, mass, objective.system.contact_stiffness)
        pipeline = importlib.import_module(f"brax.{objective.pipeline}.pipeline")
        return cls(pipeline, steps, system, arm, objective.system.gains, obstacles, stiffness, mass)

    def init(self, q: jax.Array, v: jax.Array) -> _Motion:
        """The start at joint angles and speeds (n, B)."""
        lanes = q.shape[1]
        displacement = jnp.zeros((lanes, 0), q.dtype)
        if self.obstacles is not None:
            moved = self.obstacles.center - self.obstacles.rest
            displacement = jnp.broadcast_to(moved, (*moved.shape[:2], lanes)).T.reshape(lanes, -1)
        positions = jnp.concatenate([displacement, q.T], axis=1)
        velocities = jnp.concatenate([jnp.zeros_like(displacement), v.T], axis=1)
        state = jax.vmap(self.pipeline.init, in_axes=(None, 0, 0))(self.system, positions, velocities)
        return _Motion(state, v)

    def joints(self, state: Any) -> jax.Array:
        """Joint angles (n, B)."""
        return state.q[:, -self.arm.n :].T

    def spheres(self, state: Any) -> tuple[jax.Array, jax.Array]:
        """Displacements from rest and velocities (B, K, 3)."""
        shape = (state.q.shape[0], len(self.mass), 3)
        return state.q[:, : -self.arm.n].reshape(shape), state.qd[:, : -self.arm.n].reshape(shape)

    def pose(self, q: jax.Array) -> Pose:
        """Flange poses at joint angles (n, B)."""
        frames = link_frames(self.arm, q, make_keep(q))
        return Pose(frames.flange, frames.flange_rotation)

    def advance(self, motion: _Motion, reference: Reference) -> tuple[_Motion, jax.Array]:
        """Advance under one torque of the laws; also returns the mean contact force (B, K, 3) on each sphere."""
        start, timestep, lanes = motion.state, self.system.opt.timestep, motion.v.shape[1]
        held = 0.0 if self.steps == 1 else timestep * self.steps
        bias = jax.vmap(self.bias)(start, motion.v.T)
        torque = law_torque(self.arm, self.gains, self.joints(start), motion.v, reference, held).T + bias

        def step(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], None]:
            state, total = carry
            displacement, velocity = self.spheres(state)
            restoring = -jnp.einsum("ij,bjk->bik", self.stiffness, displacement)
            force = restoring - self.mass[:, None] / timestep * velocity
            act = jnp.concatenate([force.reshape(lanes, -1), torque], axis=1)
            state = jax.vmap(self.pipeline.step, in_axes=(None, 0, 0))(self.system, state, act)
            velocity = self.spheres(state)[1]
            return (state, total + self.mass[:, None] / timestep * velocity - restoring), None

        nothing = jnp.zeros((lanes, len(self.mass), 3), self.mass.dtype)
        if self.steps == 1:
            (state, force), _ = step((start, nothing), None)
            return _Motion(state, state.qd[:, -self.arm.n :].T), force

        def half(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], jax.Array]:
            (state, total), _ = jax.lax.scan(step, carry, length=self.steps // 2)
            return (state, total), self.joints(state)

        (state, total), ends = jax.lax.scan(half, (start, nothing), length=2)
        return _Motion(state, (ends[1] - ends[0]) / (0.5 * held)), total / self.steps

    def bias(self, state: Any, v: jax.Array) -> jax.Array:
        """C (n,) of one candidate by Brax's own inverse dynamics at joint speeds v (n,)."""
        if not isinstance(state, GeneralizedState):
            qd = jnp.concatenate([jnp.zeros_like(state.qd[: -self.arm.n]), v])
            start = GeneralizedState.init(state.q, qd, *kinematics.forward(self.system, state.q, qd))
            state = brax_dynamics.transform_com(self.system, start)
        return brax_dynamics.inverse(self.system, state)[-self.arm.n :]

    def link_force(self, state: Any, force: jax.Array) -> jax.Array:
        """Force (L, B) on each of the arm's `contact_links` from the forces (B, K, 3) on the spheres."""
        lanes, links = len(force), len(self.arm.contact_links)
        if self.obstacles is None:
            return jnp.zeros((links, lanes), force.dtype)
        q = self.joints(state)
        frames = link_frames(self.arm, q, make_keep(q))
        displacement, _ = self.spheres(state)
        gaps = _gaps(self.arm, frames, self.obstacles._replace(center=self.obstacles.rest + displacement.T))
        nearest = jax.nn.one_hot(gaps.argmin(axis=0), len(gaps), axis=0, dtype=force.dtype)
        size = jnp.sqrt((force**2).sum(axis=2) + 1e-12).T
        return collect((nearest * size).sum(axis=1)[None], self.arm.capsule_place, links)[0]


def law_torque(
    arm: ArmModel,
    gains: ImpedanceSettings,
    q: jax.Array,
    v: jax.Array,
    reference: Reference,
    held: float | jax.Array = 0.0,
) -> jax.Array:
    """τ of law (3) without its C + g, (n, B), N m, at joint angles and speeds (n, B).

    `held`: time for which the torque stays, s, over which the gains are then implicit, as in `pipeline.step`.
    """
    q = q + 0.5 * held * v
    keep = make_keep(q)
    frames = link_frames(arm, q, keep)
    dynamics = arm_dynamics(arm, frames, keep)
    drift = flange_drift(frames, v, keep)
    # Without contact the law makes the arm move as M q̈ = τ − C − g.
    acceleration = joint_acceleration(gains, frames, dynamics, drift, q, v, reference, None, held)
    mass_matrix = dynamics.mass_matrix
    rows = [
        sum(mass_matrix[min(row, column), max(row, column)] * acceleration[column] for column in range(arm.n))
        for row in range(arm.n)
    ]
    return jnp.stack(rows)


def _gaps(arm: ArmModel, frames: Frames, obstacles: Obstacles) -> jax.Array:
    """Distance (C, K, B) of the spheres' surfaces from the capsules', m."""
    start, segment = (points[:, :, None] for points in capsule_segments(arm, frames))
    to_sphere = obstacles.center[:, None] - start
    share = jnp.clip(dot(to_sphere, segment) / dot(segment, segment), 0.0, 1.0)
    gap = share[None] * segment - to_sphere
    return jnp.sqrt(dot(gap, gap) + 1e-12) - arm.capsule_radius[:, None, None] - obstacles.radius


@functools.cache
def _load(pipeline: str, count: int, arm: Arm) -> tuple[brax.System, ArmModel]:
    """The system of a pipeline with `count` spheres, and the arm that the laws use."""
    bodies = [sphere_body(index) for index in range(count)]
    contacts = {"max_contact_points": [_CONTACTS * count]} if count else {}
    system = load_system(build_mjcf(arm, obstacles=bodies, fields=contacts))
    with jax.ensure_compile_time_eval():
        model = read_arm(system)
        every = np.arange(system.qd_size())
        unlimited = np.tile([-np.inf, np.inf], (len(every), 1))
        ones, zeros = np.ones(len(every)), np.zeros(len(every))
        actuator = Actuator(every, every, unlimited, unlimited, ones, ones, zeros, zeros)
        system = system.replace(actuator=jax.tree.map(jnp.asarray, actuator), gravity=jnp.zeros(3))
        if pipeline == "generalized":
            return system.replace(dof=system.dof.replace(limit=None)), model
        return in_maximal_coordinates(system, model)
