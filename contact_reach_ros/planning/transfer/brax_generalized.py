"""The same problem rolled out by Brax's own pipeline `generalized`, for comparison.

The arm and the obstacle spheres are bodies of a Brax system. The laws (1)-(3) are computed from its state and act on it
as joint torques, `_TORQUES` times per step of this package's own pipeline. Gravity, which the laws cancel on the arm
and the springs carry on the spheres, is left out. The laws are computed for all candidates at once by this package's
own fast code: the comparison is about the physics.

A sphere moves on three sliders. Springs, dampers and edges act on these as actuator forces. As in this package's own
pipeline, spheres have no mass of their own; the body that Brax moves has the mass m = dt (damping + dt stiffness), with
which Brax's explicit step becomes the implicit one of the sphere without mass.

Contact is soft, after MuJoCo's model, with the planner's stiffness. Its solver takes time with the square of the
constraints, for each step and candidate: only the deepest contacts count, and joints have no stops, as in this
package's own pipeline. Brax returns no contact forces. Here a sphere's contact force is the one that its spring, damper
and edges need for its motion; it is attributed to the nearest link.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax.base import Actuator
from brax.generalized import dynamics as brax_dynamics
from brax.generalized import pipeline
from brax.generalized.base import State

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, build_mjcf, numbers
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, on_the_way
from contact_reach_ros.planning.terms import Problem, Rollout
from contact_reach_ros.planning.transfer.closed_loop import Reference, joint_acceleration
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.dynamics import (
    Frames,
    arm_dynamics,
    capsule_segments,
    flange_drift,
    link_frames,
)
from contact_reach_ros.planning.transfer.lanes import collect, dot, make_keep
from contact_reach_ros.planning.transfer.model import ArmModel, arm_model, load_system
from contact_reach_ros.planning.transfer.pipeline import Pose

SPHERE = 2
"""MuJoCo's number of this type of geometry."""

_TORQUES = 2
"""Steps of Brax, with a torque each, per step of this package's own pipeline, 25 ms at the defaults."""

_CONTACTS = 2
"""Of each sphere, on the average: those that are deepest among all. Without a bound each capsule adds one."""

_IMPEDANCE = 0.9
_FRICTION = 0.2
_CONTACT_DAMPING = 10.0
"""N s/m."""


@dataclasses.dataclass(frozen=True, eq=False)
class BraxObjective(Objective):
    """Cost (5) over Brax's own pipeline."""

    table: Arm
    """The arm whose MJCF Brax loads, with spheres."""

    @property
    def integration_steps(self) -> int:
        """Steps of Brax over the horizon."""
        return super().integration_steps * _TORQUES

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run Brax under the actions (H, 6 + n, B), knot by knot."""
        lanes = actions.shape[-1]
        world = _World.of(self, problem.obstacles)
        q = jnp.broadcast_to(problem.q, (world.arm.n, lanes))
        state = world.init(q, jnp.broadcast_to(problem.v, (world.arm.n, lanes)))
        pose = world.pose(q)

        def knot(carry: tuple[State, Pose, Reference | None], action: jax.Array) -> tuple[tuple, tuple]:
            state, pose, before = carry
            reference = self.latch(*world.joints(state), pose, action)

            def substep(state: State, share: jax.Array | None) -> tuple[State, jax.Array]:
                act = on_the_way(before, reference, share)
                state, forces = jax.lax.scan(lambda state, _: world.advance(state, act), state, length=_TORQUES)
                return state, world.link_force(state, forces.mean(axis=0))

            state, link_force = jax.lax.scan(substep, state, self.shares(), self.substeps)
            contact = jax.vmap(self.measure)(link_force)
            q, _ = world.joints(state)
            pose, capsules = self.end_of_knot(problem, q)
            carry = state, pose, self.reached(before, reference)
            return carry, (q, pose, reference, link_force.max(axis=0), contact.max(axis=0), capsules)

        start = state, pose, self.before(problem, q, pose)
        _, (later_q, poses, reference, link_force, contact, capsules) = jax.lax.scan(knot, start, actions)
        return Rollout(
            q=jnp.concatenate([q[None], later_q]),
            pose=jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), pose, poses),
            reference=reference,
            link_force=link_force,
            contact=contact,
            capsules=capsules,
        )


class _World(NamedTuple):
    """Arm and spheres in Brax, all candidates side by side: Brax's arrays have them on the first axis."""

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
        system = _load(count, objective.table)
        timestep = objective.system.timestep / _TORQUES
        system = system.tree_replace({"opt.timestep": timestep})
        stiffness, mass = jnp.zeros((0, 0)), jnp.zeros(0)
        if obstacles is not None:
            stiffness, damping = network(obstacles)
            mass = timestep * (jnp.abs(damping).sum(axis=1) + timestep * jnp.abs(stiffness).sum(axis=1))
            system = _with_spheres(system, obstacles, mass, objective.system.contact_stiffness)
        return cls(system, arm_model(objective.table), objective.system.gains, obstacles, stiffness, mass)

    def init(self, q: jax.Array, v: jax.Array) -> State:
        """The start at joint angles and speeds (n, B)."""
        lanes = q.shape[1]
        displacement = jnp.zeros((lanes, 0), q.dtype)
        if self.obstacles is not None:
            moved = self.obstacles.center - self.obstacles.rest
            displacement = jnp.broadcast_to(moved, (*moved.shape[:2], lanes)).T.reshape(lanes, -1)
        positions = jnp.concatenate([displacement, q.T], axis=1)
        velocities = jnp.concatenate([jnp.zeros_like(displacement), v.T], axis=1)
        return jax.vmap(pipeline.init, in_axes=(None, 0, 0))(self.system, positions, velocities)

    def joints(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Joint angles, rad, and speeds, rad/s, (n, B) each."""
        return state.q[:, -self.arm.n :].T, state.qd[:, -self.arm.n :].T

    def spheres(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Displacements from rest, m, and velocities, m/s, (B, K, 3) each."""
        shape = (state.q.shape[0], len(self.mass), 3)
        return state.q[:, : -self.arm.n].reshape(shape), state.qd[:, : -self.arm.n].reshape(shape)

    def pose(self, q: jax.Array) -> Pose:
        """Flange poses at joint angles (n, B)."""
        frames = link_frames(self.arm, q, make_keep(q))
        return Pose(frames.flange, frames.flange_rotation)

    def advance(self, state: State, reference: Reference) -> tuple[State, jax.Array]:
        """Advance by one step of Brax; also returns the contact force (B, K, 3) on each sphere, N."""
        timestep, lanes = self.system.opt.timestep, len(state.q)
        # C of each candidate by Brax's own inverse dynamics.
        bias = jax.vmap(brax_dynamics.inverse, in_axes=(None, 0))(self.system, state)[:, -self.arm.n :]
        torque = law_torque(self.arm, self.gains, *self.joints(state), reference).T + bias
        displacement, velocity = self.spheres(state)
        restoring = -jnp.einsum("ij,bjk->bik", self.stiffness, displacement)
        force = restoring - self.mass[:, None] / timestep * velocity
        act = jnp.concatenate([force.reshape(lanes, -1), torque], axis=1)
        state = jax.vmap(pipeline.step, in_axes=(None, 0, 0))(self.system, state, act)
        velocity = self.spheres(state)[1]
        return state, self.mass[:, None] / timestep * velocity - restoring

    def link_force(self, state: State, force: jax.Array) -> jax.Array:
        """Force (L, B) on each of the arm's `contact_links` from the forces (B, K, 3) on the spheres, N."""
        lanes, links = len(force), len(self.arm.contact_links)
        if self.obstacles is None:
            return jnp.zeros((links, lanes), force.dtype)
        q, _ = self.joints(state)
        frames = link_frames(self.arm, q, make_keep(q))
        displacement, _ = self.spheres(state)
        gaps = _gaps(self.arm, frames, self.obstacles._replace(center=self.obstacles.rest + displacement.T))
        nearest = jax.nn.one_hot(gaps.argmin(axis=0), len(gaps), axis=0, dtype=force.dtype)
        size = jnp.sqrt((force**2).sum(axis=2) + 1e-12).T
        return collect((nearest * size).sum(axis=1)[None], self.arm.capsule_place, links)[0]


def law_torque(arm: ArmModel, gains: ImpedanceSettings, q: jax.Array, v: jax.Array, reference: Reference) -> jax.Array:
    """τ of law (3) without its C + g, (n, B), N m, at joint angles and speeds (n, B)."""
    keep = make_keep(q)
    frames = link_frames(arm, q, keep)
    dynamics = arm_dynamics(arm, frames, keep)
    drift = flange_drift(frames, v, keep)
    # Without contact the law makes the arm move as M q̈ = τ − C − g.
    acceleration = joint_acceleration(gains, frames, dynamics, drift, q, v, reference, None, 0.0)
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
def _load(count: int, arm: Arm) -> brax.System:
    """A system with `count` spheres."""
    bodies = [sphere_body(index) for index in range(count)]
    contacts = {"max_contact_points": [_CONTACTS * count]} if count else {}
    system = load_system(build_mjcf(arm, obstacles=bodies, fields=contacts))
    with jax.ensure_compile_time_eval():
        every = np.arange(system.qd_size())
        unlimited = np.tile([-np.inf, np.inf], (len(every), 1))
        ones, zeros = np.ones(len(every)), np.zeros(len(every))
        actuator = Actuator(every, every, unlimited, unlimited, ones, ones, zeros, zeros)
        system = system.replace(actuator=jax.tree.map(jnp.asarray, actuator), gravity=jnp.zeros(3))
        return system.replace(dof=system.dof.replace(limit=None))


def sphere_body(index: int, rest: Iterable[float] = (0.0, 0.0, 0.0), radius: float = 0.1) -> Element:
    """A sphere on sliders along x, y and z, at `rest` (3,) and with this radius, m."""
    body = Element("body", name=f"sphere_{index}", pos=numbers(rest))
    for axis in ("1 0 0", "0 1 0", "0 0 1"):
        SubElement(body, "joint", type="slide", axis=axis)
    SubElement(
        body,
        "geom",
        type="sphere",
        size=repr(radius),
        mass="0.1",
        contype=str(OBSTACLE_CONTACT_TYPE),
        conaffinity=str(ROBOT_CONTACT_TYPE),
    )
    return body


def network(obstacles: Obstacles) -> tuple[jax.Array, jax.Array]:
    """Stiffness and damping matrices (K, K) of the spheres: L = W⁻ᵀ diag(rates) W⁻¹ and D = W⁻ᵀ W⁻¹."""
    amplitudes = obstacles.amplitudes
    return amplitudes.T @ (obstacles.rates[:, None] * amplitudes), amplitudes.T @ amplitudes


def _with_spheres(system: brax.System, obstacles: Obstacles, mass: jax.Array, contact_stiffness: float) -> brax.System:
    """Put the spheres of a problem into a system: positions, sizes, masses and the stiffness of contact with them."""
    count = len(mass)
    link = system.link
    # MuJoCo's soft contact scales its stiffness by the inverse masses and by (1 - d), and a friction pyramid has four
    # edges that share the normal force.
    pyramid = 0.5 * _FRICTION**2 * (1.0 + _FRICTION**2)
    scale = (1.0 - _IMPEDANCE) * pyramid / mass
    solref = jnp.stack([-contact_stiffness * scale, -_CONTACT_DAMPING * scale], axis=1)
    spheres = jnp.flatnonzero(np.asarray(system.geom_type) == SPHERE, size=count)
    return system.tree_replace(
        {
            "link.transform.pos": jnp.asarray(link.transform.pos).at[:count].set(obstacles.rest[:, :, 0].T),
            "link.inertia.mass": jnp.asarray(link.inertia.mass).at[:count].set(mass),
            "link.invweight": jnp.zeros_like(link.invweight).at[:count].set(1.0 / mass),
            "geom_size": jnp.asarray(system.geom_size).at[spheres, 0].set(obstacles.radius[:, 0]),
            # Of two geometries, MuJoCo takes the smaller reference, the larger friction and the mean impedance.
            "geom_solref": jnp.asarray(system.geom_solref).at[spheres].set(solref),
            "geom_friction": jnp.asarray(system.geom_friction).at[:, 0].set(_FRICTION),
            "geom_solimp": jnp.asarray(system.geom_solimp).at[:, :2].set(_IMPEDANCE),
        }
    )
