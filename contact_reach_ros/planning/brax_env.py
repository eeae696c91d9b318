"""Brax as an interface and as a transfer function: the environment `contact_reach`, and the pipeline `generalized`.

The environment has a scene, law (3) inside, and cost (5) as negative reward. Its pipeline is the closed loop of the
planner. Importing this module makes it known to `brax.envs.get_environment`.

`BraxObjective` rolls the same problem out by Brax's own pipeline, for comparison. The arm and the obstacle spheres are
bodies of a Brax system. The laws (1)-(3) are computed from its state and act on it as joint torques, `_TORQUES` times
per step of this package's own pipeline. Gravity, which the laws cancel on the arm and the springs carry on the spheres,
is left out. The laws are computed for all candidates at once by this package's own fast code: the comparison is about
the physics.

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
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax import base, envs, kinematics
from brax.base import Actuator
from brax.envs.base import PipelineEnv
from brax.envs.base import State as EpisodeState
from brax.generalized import dynamics as brax_dynamics
from brax.generalized import pipeline as brax_pipeline
from brax.generalized.base import State as BraxState
from flax import struct

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.cost import Objective, ReferenceSpace, Step
from contact_reach_ros.planning.obstacles import ObstacleReader, nearest_bodies
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Context, Problem, Rollout, term_weights, weighted_terms
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.arithmetic import collect, dot, single
from contact_reach_ros.planning.transfer.contact import CONTACT_STIFFNESS, Obstacles
from contact_reach_ros.planning.transfer.dynamics import (
    arm_dynamics,
    flange_drift,
    link_frames,
    place_capsules,
)
from contact_reach_ros.planning.transfer.model import load_system
from contact_reach_ros.planning.transfer.pipeline import Reference, joint_acceleration
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions, sphere_capacity

NAME = "contact_reach"

_SPHERE = 2
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

    def transfer(self, problem: Problem, lanes: int) -> tuple[_Motion, Step]:
        """The start in each lane, and Brax's steps under the laws."""
        world = _World(self, problem.obstacles)
        start = (jnp.broadcast_to(part, (self.table.n, lanes)) for part in (problem.q, problem.v))
        return world.init(*start), world.step


class _Motion(NamedTuple):
    """State of Brax, and what `Objective` reads of a state."""

    q: jax.Array
    """(n, B), rad."""
    qd: jax.Array
    """(n, B), rad/s."""
    link_force: jax.Array
    """(L, B) mean force in the last step on each of the arm's `contact_links`, N."""
    physics: BraxState


class _World:
    """Arm and spheres in Brax, all candidates side by side: Brax's arrays have them on the first axis."""

    def __init__(self, objective: BraxObjective, obstacles: Obstacles | None) -> None:
        count = 0 if obstacles is None else obstacles.radius.shape[0]
        system = _load(count, objective.table)
        timestep = objective.system.timestep / _TORQUES
        system = system.tree_replace({"opt.timestep": timestep})
        stiffness, mass = jnp.zeros((0, 0)), jnp.zeros(0)
        if obstacles is not None:
            # Of the network: L = W⁻ᵀ diag(rates) W⁻¹ and D = W⁻ᵀ W⁻¹.
            amplitudes = obstacles.amplitudes
            stiffness, damping = amplitudes.T @ (obstacles.rates[:, None] * amplitudes), amplitudes.T @ amplitudes
            mass = timestep * (jnp.abs(damping).sum(axis=1) + timestep * jnp.abs(stiffness).sum(axis=1))
            link = system.link
            # MuJoCo's soft contact scales its stiffness by the inverse masses and by (1 - d), and a friction pyramid
            # has four edges that share the normal force.
            pyramid = 0.5 * _FRICTION**2 * (1.0 + _FRICTION**2)
            scale = (1.0 - _IMPEDANCE) * pyramid / mass
            solref = jnp.stack([-CONTACT_STIFFNESS * scale, -_CONTACT_DAMPING * scale], axis=1)
            spheres = jnp.flatnonzero(np.asarray(system.geom_type) == _SPHERE, size=count)
            system = system.tree_replace(
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
        self.system, self.obstacles = system, obstacles
        self.arm, self.gains = objective.system.arm, objective.system.gains
        self.stiffness, self.mass = stiffness, mass
        """(K, K) of the springs and edges, N/m, and (K,) of the bodies that stand for the spheres, kg."""

    def init(self, q: jax.Array, v: jax.Array) -> _Motion:
        """The start at joint angles and speeds (n, B)."""
        lanes = q.shape[1]
        displacement = jnp.zeros((lanes, 0), q.dtype)
        if self.obstacles is not None:
            moved = self.obstacles.center - self.obstacles.rest
            displacement = jnp.broadcast_to(moved, (*moved.shape[:2], lanes)).T.reshape(lanes, -1)
        positions = jnp.concatenate([displacement, q.T], axis=1)
        velocities = jnp.concatenate([jnp.zeros_like(displacement), v.T], axis=1)
        physics = jax.vmap(brax_pipeline.init, in_axes=(None, 0, 0))(self.system, positions, velocities)
        return _Motion(q, v, jnp.zeros((len(self.arm.contact_links), lanes), q.dtype), physics)

    def step(self, motion: _Motion, reference: Reference) -> _Motion:
        """Advance by one step of this package's own pipeline under a reference."""
        physics, forces = jax.lax.scan(lambda state, _: self.advance(state, reference), motion.physics, length=_TORQUES)
        return _Motion(*self.joints(physics), self.link_force(physics, forces.mean(axis=0)), physics)

    def joints(self, state: BraxState) -> tuple[jax.Array, jax.Array]:
        """Joint angles, rad, and speeds, rad/s, (n, B) each."""
        return state.q[:, -self.arm.n :].T, state.qd[:, -self.arm.n :].T

    def spheres(self, state: BraxState) -> tuple[jax.Array, jax.Array]:
        """Displacements from rest, m, and velocities, m/s, (B, K, 3) each."""
        shape = (state.q.shape[0], len(self.mass), 3)
        return state.q[:, : -self.arm.n].reshape(shape), state.qd[:, : -self.arm.n].reshape(shape)

    def advance(self, state: BraxState, reference: Reference) -> tuple[BraxState, jax.Array]:
        """Advance by one step of Brax; also returns the contact force (B, K, 3) on each sphere, N."""
        timestep, lanes = self.system.opt.timestep, len(state.q)
        # C of each candidate by Brax's own inverse dynamics.
        bias = jax.vmap(brax_dynamics.inverse, in_axes=(None, 0))(self.system, state)[:, -self.arm.n :]
        arm, (q, v) = self.arm, self.joints(state)
        frames = link_frames(arm, q)
        dynamics = arm_dynamics(arm, frames)
        drift = flange_drift(frames, v)
        # Without contact the law makes the arm move as M q̈ = τ − C − g.
        acceleration = joint_acceleration(self.gains, frames, dynamics, drift, q, v, reference, None, 0.0)
        mass_matrix = dynamics.mass_matrix
        rows = [
            sum(mass_matrix[min(row, column), max(row, column)] * acceleration[column] for column in range(arm.n))
            for row in range(arm.n)
        ]
        torque = jnp.stack(rows).T + bias
        displacement, velocity = self.spheres(state)
        restoring = -jnp.einsum("ij,bjk->bik", self.stiffness, displacement)
        force = restoring - self.mass[:, None] / timestep * velocity
        act = jnp.concatenate([force.reshape(lanes, -1), torque], axis=1)
        state = jax.vmap(brax_pipeline.step, in_axes=(None, 0, 0))(self.system, state, act)
        velocity = self.spheres(state)[1]
        return state, self.mass[:, None] / timestep * velocity - restoring

    def link_force(self, state: BraxState, force: jax.Array) -> jax.Array:
        """Force (L, B) on each of the arm's `contact_links` from the forces (B, K, 3) on the spheres, N."""
        links = len(self.arm.contact_links)
        if self.obstacles is None:
            return jnp.zeros((links, len(force)), force.dtype)
        q, _ = self.joints(state)
        displacement, _ = self.spheres(state)
        start, segment = (points[:, :, None] for points in place_capsules(self.arm, link_frames(self.arm, q)))
        to_sphere = (self.obstacles.rest + displacement.T)[:, None] - start
        share = jnp.clip(dot(to_sphere, segment) / dot(segment, segment), 0.0, 1.0)
        gap = share[None] * segment - to_sphere
        # (C, K, B) of the spheres' surfaces from the capsules'.
        distance = jnp.sqrt(dot(gap, gap) + 1e-12) - self.arm.capsule_radius[:, None, None] - self.obstacles.radius
        nearest = jax.nn.one_hot(distance.argmin(axis=0), len(distance), axis=0, dtype=force.dtype)
        size = jnp.sqrt((force**2).sum(axis=2) + 1e-12).T
        return collect((nearest * size).sum(axis=1)[None], self.arm.capsule_place, links)[0]


@functools.cache
def _load(count: int, arm: Arm) -> brax.System:
    """A system with `count` spheres."""
    bodies = [_sphere_body(index) for index in range(count)]
    contacts = {"max_contact_points": [_CONTACTS * count]} if count else {}
    system = load_system(build_mjcf(arm, obstacles=bodies, fields=contacts))
    with jax.ensure_compile_time_eval():
        every = np.arange(system.qd_size())
        unlimited = np.tile([-np.inf, np.inf], (len(every), 1))
        ones, zeros = np.ones(len(every)), np.zeros(len(every))
        actuator = Actuator(every, every, unlimited, unlimited, ones, ones, zeros, zeros)
        system = system.replace(actuator=jax.tree.map(jnp.asarray, actuator), gravity=jnp.zeros(3))
        return system.replace(dof=system.dof.replace(limit=None))


def _sphere_body(index: int) -> Element:
    """A sphere on sliders along x, y and z; a problem has its place and size."""
    body = Element("body", name=f"sphere_{index}")
    for axis in ("1 0 0", "0 1 0", "0 0 1"):
        SubElement(body, "joint", type="slide", axis=axis)
    contact = {"contype": str(OBSTACLE_CONTACT_TYPE), "conaffinity": str(ROBOT_CONTACT_TYPE)}
    SubElement(body, "geom", contact, type="sphere", size="0.1", mass="0.1")
    return body


@struct.dataclass
class State(base.State):
    """Brax's state, and what the laws remember, with one lane."""

    before: Reference | None
    """Reference in force; None if it steps."""
    obstacles: Obstacles | None
    """Spheres; None in free space."""
    link_force: jax.Array
    """(L, 1) largest force in the last knot on each of the arm's links with capsules, N."""


class ContactReach(PipelineEnv):
    """One step is one knot of a plan: an action, Δx and Δq in units of γ, moves x_d and q_d for 0.1 s.

    Observed are joint angles, speeds, tip position, the way to the target, and the contact force on each link. The
    reward is the knot's share of −cost (5), so that the return of an episode is −cost of the whole motion as one plan.
    The target's orientation is free.

    Parameters
    ----------
    scene
        A scene, or the name of one, drawn with seed 0.
    settings, gains
        Of the planner and the controller.
    """

    def __init__(
        self,
        scene: Scene | str = "ball",
        settings: PlanningSettings | None = None,
        gains: ImpedanceSettings | None = None,
    ) -> None:
        scene = load_scene(scene) if isinstance(scene, str) else scene
        settings, gains, arm = settings or PlanningSettings(), gains or ImpedanceSettings(), scene.arm
        spheres = obstacle_spheres(scene, rest_positions(scene))
        obstacles = ObstacleReader(arm, sphere_capacity(scene)).read(scene.start, spheres)
        sys = load_system(build_mjcf(arm))
        super().__init__(sys.tree_replace({"opt.timestep": settings.knot_duration}), "generalized")
        self._compiled = self.sys
        settings = dataclasses.replace(settings, pipeline="closed_loop", horizon=1)
        self._problem = Problem(
            q=single(scene.start[:, None]),
            v=single(np.zeros((arm.n, 1))),
            obstacles=obstacles,
            goal_position=single(scene.target[:, None]),
            goal_rotation=single(np.eye(3)[:, :, None]),
            weights={name: single(weight) for name, weight in (term_weights(settings) | {"orientation": 0.0}).items()},
            permitted_force=single(ContactBudget().permitted_force),
            bodies=nearest_bodies(arm, scene.start, scene.environment),
        )
        self._space = ReferenceSpace(arm, settings, gains)
        self._objective = self._space.objective

    @property
    def backend(self) -> str:
        """Name of the pipeline, which is none of Brax's own."""
        return NAME

    @property
    def action_size(self) -> int:
        """The variables of a knot, in units of their bounds γ: Δx and Δq, without what has no effect."""
        return len(self._space.bounds)

    def pipeline_init(self, q: jax.Array, qd: jax.Array, *_: Any) -> State:
        """State of the closed loop at joint angles and speeds (n,), with the arm held where it is.

        Raises
        ------
        SettingsError
            If the system is not the environment's own, as with randomised domains.
        """
        if self.sys is not self._compiled:
            raise SettingsError(
                "the system is not the one that this environment was made with; expected that one, whose fields are "
                "constants of the compiled program: domains cannot be randomised"
            )
        joints, objective = q[:, None], self._objective
        before = objective.before(self._problem, joints, pipeline.tip_pose(objective.system, joints))
        none = jnp.zeros((len(objective.system.arm.contact_links), 1), q.dtype)
        return State(q, qd, *kinematics.forward(self.sys, q, qd), None, before, self._problem.obstacles, none)

    def pipeline_step(self, pipeline_state: State, action: jax.Array) -> State:
        """State of the closed loop after one knot under the action {Δx, Δq} (6 + n,), m and rad."""
        return self._knot(pipeline_state, action[None, :, None])[0]

    def reset(self, rng: jax.Array) -> EpisodeState:
        """The start of the scene, at rest."""
        q, v = self._problem.q[:, 0], self._problem.v[:, 0]
        pipeline_state = self.pipeline_init(jnp.asarray(q), jnp.asarray(v))
        start = pipeline.tip_pose(self._objective.system, pipeline_state.q[:, None]).position
        zero, info = jnp.zeros(()), {"start": start, "lead": jnp.zeros((3, 1))}
        metrics = dict.fromkeys((*self._problem.weights, "distance", "contact_force"), zero)
        return EpisodeState(pipeline_state, self._observe(pipeline_state, start), zero, zero, metrics, info)

    def step(self, state: EpisodeState, action: jax.Array) -> EpisodeState:
        """One knot; `action` is clipped to [-1, 1]."""
        system = self._objective.system
        actions = self._space.actions(jnp.clip(action, -1.0, 1.0)[:, None], self._problem)
        after, rollout = self._knot(state.pipeline_state, actions)
        # Progress counts from where the episode started.
        position = rollout.pose.position.at[0].set(state.info["start"])
        rollout = rollout._replace(pose=rollout.pose._replace(position=position))
        context = Context(system.arm, self.dt, self._problem, actions, rollout, state.info["lead"], system.gains.task)
        terms = {name: values[0] for name, values in weighted_terms(context).items()}
        distance = jnp.linalg.norm(position[1] - self._problem.goal_position)
        # Brax's wrappers add metrics and information of their own.
        return state.replace(
            pipeline_state=after,
            obs=self._observe(after, position[1]),
            reward=-sum(terms.values(), start=jnp.zeros(())),
            done=jnp.where(jnp.isfinite(after.q).all(), 0.0, 1.0),
            metrics={**state.metrics, **terms, "distance": distance, "contact_force": rollout.contact[0, 0]},
            info={**state.info, "lead": actions[0, :3]},
        )

    def _knot(self, state: State, actions: jax.Array) -> tuple[State, Rollout]:
        """As `pipeline_step` for actions (1, 6 + n, 1), with the motion; the arithmetic is the planner's."""
        problem = self._problem._replace(
            q=state.q[:, None], v=state.qd[:, None], obstacles=state.obstacles, before=state.before
        )
        (end, _, before), rollout = self._objective.run(problem, actions)
        q, qd = end.q[:, 0], end.qd[:, 0]
        moved = kinematics.forward(self.sys, q, qd)
        return State(q, qd, *moved, None, before, end.obstacles, rollout.link_force[0]), rollout

    def _observe(self, state: State, position: jax.Array) -> jax.Array:
        lanes = (position, self._problem.goal_position - position, state.link_force)
        return jnp.concatenate([state.q, state.qd, *(array[:, 0] for array in lanes)])


envs.register_environment(NAME, ContactReach)
