"""The closed loop in Brax's own terms: as a pipeline, and as the environment `contact_reach`.

The environment has a scene, law (3) inside, and cost (5) as negative reward.

Importing this module makes the environment known to `brax.envs.get_environment`.
"""

from __future__ import annotations

import dataclasses

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax import base, envs, kinematics
from brax.envs.base import PipelineEnv
from brax.envs.base import State as EpisodeState
from flax import struct

from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.cost import Objective, knot_bounds, make_objective, on_the_way, planned
from contact_reach_ros.planning.obstacles import ObstacleReader, nearest_bodies
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Context, Problem, Rollout, term_weights, weighted_terms
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.brax_generalized import sphere_body
from contact_reach_ros.planning.transfer.closed_loop import Reference
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import load_system
from contact_reach_ros.planning.transfer.pipeline import Pose
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions, sphere_capacity

NAME = "contact_reach"


@struct.dataclass
class State(base.State):
    """Brax's state, and what the laws remember."""

    before: Reference
    """Reference from which the present one is approached, without lanes."""
    reference: Reference
    """Reference in force, without lanes."""
    phase: jax.Array
    """() steps taken in the present knot."""
    link_force: jax.Array
    """(L,) largest force in the present knot on each of the arm's links with capsules, N."""
    contact_force: jax.Array
    """() contact(·) of (4d): largest value in the present knot, N."""


class ClosedLoop:
    """The closed loop as a pipeline for `PipelineEnv`: `init(sys, q, qd)` and `step(sys, state, act)`.

    The action is that of a knot, {Δx, Δq}, which takes effect when the knot begins; law (3) is inside. All arithmetic
    is that of the planner's rollouts; only the types are Brax's.

    Parameters
    ----------
    objective
        Has the arm, the gains, the contact stiffness, the time step and the steps of a knot.
    sys
        The system that `init` and `step` get: the arm's links, and obstacle spheres on three sliders each.
    obstacles
        The spheres at rest, with one lane and their springs and dampers; None without any.
    """

    def __init__(self, objective: Objective, sys: brax.System, obstacles: Obstacles | None) -> None:
        self.objective = objective
        self.obstacles = obstacles
        self._sys = sys
        ranges = list(zip(sys.link_types, sys.dof_ranges(), strict=True))
        hinges, sliders = ([dof for kind, dofs in ranges if kind == own for dof in dofs] for own in "13")
        self.hinges, self._sliders = np.array(hinges, int), np.array(sliders, int)

    def init(
        self,
        sys: brax.System,
        q: jax.Array,
        qd: jax.Array,
        act: jax.Array | None = None,
        ctrl: jax.Array | None = None,
        debug: bool = False,
    ) -> State:
        """State at positions and velocities of all links, with the arm held where it is; the rest is ignored.

        Raises
        ------
        SettingsError
            If the system is not the one that the pipeline was made for, as with randomised domains.
        """
        if sys is not self._sys:
            raise SettingsError(
                "the system is not the one that this pipeline was made for; expected that one, whose fields are "
                "constants of the compiled program: domains cannot be randomised"
            )
        system = self.objective.system
        pose = pipeline.tip_pose(system, self._lanes(q, qd))
        hold = Reference(pose.position[:, 0], pose.rotation[..., 0], q[self.hinges])
        x, xd = kinematics.forward(sys, q, qd)
        none = jnp.zeros(len(system.arm.contact_links), q.dtype)
        return State(q, qd, x, xd, None, hold, hold, jnp.zeros((), jnp.int32), none, none.sum())

    def step(self, sys: brax.System, state: State, act: jax.Array, debug: bool = False) -> State:
        """One step under the action {Δx, Δq} (6 + n,), m and rad, which a knot reads in its first step."""
        objective, begins = self.objective, state.phase == 0
        lanes = self._lanes(state.q, state.qd)
        pose = pipeline.tip_pose(objective.system, lanes)
        latched = objective.latch(lanes.q, lanes.qd, pose, act[:, None])
        reference, before = jax.tree.map(lambda array: array[..., None], (state.reference, state.before))
        reference = jax.tree.map(lambda new, old: jnp.where(begins, new, old), latched, reference)
        shares = objective.shares()
        share = None if shares is None else shares[state.phase]
        lanes = pipeline.step(objective.system, lanes, on_the_way(before, reference, share))
        phase = (state.phase + 1) % objective.substeps
        reached = objective.reached(before if objective.ramp else None, reference) or reference
        before = jax.tree.map(lambda new, old: jnp.where(phase == 0, new, old), reached, before)
        q, qd = self._moved(state, lanes)
        x, xd = kinematics.forward(sys, q, qd)
        link_force, contact = lanes.link_force[:, 0], objective.measure(lanes.link_force)[0]
        return State(
            q,
            qd,
            x,
            xd,
            None,
            *jax.tree.map(lambda array: array[..., 0], (before, reference)),
            phase,
            jnp.where(begins, link_force, jnp.maximum(link_force, state.link_force)),
            jnp.where(begins, contact, jnp.maximum(contact, state.contact_force)),
        )

    def _lanes(self, q: jax.Array, qd: jax.Array) -> pipeline.State:
        """The state of the planner's rollouts, with one lane, from positions and velocities of all links."""
        obstacles = self.obstacles
        if obstacles is not None:
            displacement = q[self._sliders].reshape(-1, 3).T
            obstacles = obstacles._replace(center=obstacles.rest + displacement[:, :, None])
        return pipeline.init(self.objective.system, q[self.hinges, None], qd[self.hinges, None], obstacles)

    def _moved(self, state: State, lanes: pipeline.State) -> tuple[jax.Array, jax.Array]:
        """Brax's positions and velocities after a step; spheres have the mean velocity of the step."""
        q, qd = state.q.at[self.hinges].set(lanes.q[:, 0]), state.qd.at[self.hinges].set(lanes.qd[:, 0])
        if lanes.obstacles is not None:
            moved = (lanes.obstacles.center - lanes.obstacles.rest)[..., 0].T.ravel()
            speed = (moved - state.q[self._sliders]) / self.objective.system.timestep
            q, qd = q.at[self._sliders].set(moved), qd.at[self._sliders].set(speed)
        return q, qd


class ContactReach(PipelineEnv):
    """One step is one knot of a plan: an action, Δx and Δq in units of γ, moves x_d and q_d for 0.1 s.

    Observed are joint angles, speeds, tip position, the way to the target, and the contact force on each link. The
    reward is the knot's share of −cost (5), so that the return of an episode is −cost of the whole motion as one plan.

    Parameters
    ----------
    scene
        A scene, or the name of one, drawn with seed 0.
    settings, gains
        Of the planner and the controller.
    permitted_force
        ε of (4d), N; by default the contact budget's.
    start_spread
        Joints start within this of the scene's start, rad.
    rotation
        Orientation of the target (3, 3); None leaves it free.

    """

    def __init__(
        self,
        scene: Scene | str = "ball",
        settings: PlanningSettings | None = None,
        gains: ImpedanceSettings | None = None,
        permitted_force: float | None = None,
        start_spread: float = 0.0,
        rotation: np.ndarray | None = None,
    ) -> None:
        scene = load_scene(scene) if isinstance(scene, str) else scene
        settings, gains, arm = settings or PlanningSettings(), gains or ImpedanceSettings(), scene.arm
        spheres = obstacle_spheres(scene, rest_positions(scene))
        obstacles, _ = ObstacleReader(arm, sphere_capacity(scene)).read(scene.start, spheres)
        bodies = []
        if obstacles is not None:
            spheres_at = zip(obstacles.rest[..., 0].T.tolist(), obstacles.radius[:, 0].tolist(), strict=True)
            bodies = [sphere_body(index, rest, radius) for index, (rest, radius) in enumerate(spheres_at)]
        sys = load_system(build_mjcf(arm, obstacles=bodies))
        sys = sys.tree_replace({"opt.timestep": settings.knot_duration / settings.substeps})
        super().__init__(sys, "generalized", settings.substeps)
        settings = dataclasses.replace(settings, pipeline="closed_loop", null_space="planned", horizon=1)
        self._loop = ClosedLoop(make_objective(arm, settings, gains), sys, obstacles)
        self._backend, self._pipeline = NAME, self._loop
        self._planned = np.flatnonzero(planned(arm, settings, gains))
        self._bounds = jnp.asarray(knot_bounds(arm, settings)[self._planned], jnp.float32)
        self._start = jnp.zeros(sys.q_size()).at[self._loop.hinges].set(scene.start)
        self._spread, self._knot_duration = start_spread, settings.knot_duration
        weights = term_weights(settings)
        if rotation is None:
            weights["orientation"] = 0.0
        force = ContactBudget().permitted_force if permitted_force is None else permitted_force
        self._problem = Problem(
            q=single(scene.start[:, None]),
            v=single(np.zeros((arm.n, 1))),
            obstacles=None,
            goal_position=single(scene.target[:, None]),
            goal_rotation=single((np.eye(3) if rotation is None else rotation)[:, :, None]),
            weights={name: single(weight) for name, weight in weights.items()},
            permitted_force=single(force),
            bodies=nearest_bodies(arm, scene.start, scene.environment),
        )

    @property
    def action_size(self) -> int:
        """The variables of a knot, in units of their bounds γ: Δx and Δq, without what has no effect."""
        return len(self._bounds)

    def reset(self, rng: jax.Array) -> EpisodeState:
        """The start of the scene, at rest."""
        hinges = self._loop.hinges
        noise = jax.random.uniform(rng, (len(hinges),), minval=-self._spread, maxval=self._spread)
        pipeline_state = self.pipeline_init(self._start.at[hinges].add(noise), jnp.zeros(self.sys.qd_size()))
        zero = jnp.zeros(())
        info = {
            "start": pipeline_state.reference.position,
            "lead": jnp.zeros(3),
            "knots": jnp.zeros((), jnp.int32),
        }
        metrics = dict.fromkeys((*self._problem.weights, "distance", "contact_force"), zero)
        observation = self._observe(pipeline_state, pipeline_state.reference.position)
        return EpisodeState(pipeline_state, observation, zero, zero, metrics, info)

    def step(self, state: EpisodeState, action: jax.Array) -> EpisodeState:
        """One knot; `action` is clipped to [-1, 1]."""
        before, objective = state.pipeline_state, self._loop.objective
        scaled = jnp.clip(action, -1.0, 1.0) * self._bounds
        action = jnp.zeros(objective.system.action_size).at[self._planned].set(scaled)
        after = self.pipeline_step(before, action)
        q = jnp.stack([before.q, after.q])[:, self._loop.hinges, None]
        tip, capsules = objective.end_of_knot(self._problem, q[1])
        # Progress counts from where the episode started.
        start = Pose(state.info["start"][:, None], tip.rotation)
        rollout = Rollout(
            q=q,
            pose=jax.tree.map(lambda first, last: jnp.stack([first, last]), start, tip),
            reference=jax.tree.map(lambda array: array[None, ..., None], after.reference),
            link_force=after.link_force[None, :, None],
            contact=after.contact_force[None, None],
            capsules=jax.tree.map(lambda array: array[None], capsules),
        )
        lead = state.info["lead"]
        if not objective.ramp:
            # Nothing was in force before the first knot.
            lead = jnp.where(state.info["knots"] == 0, action[:3], lead)
        arm, duration = objective.system.arm, self._knot_duration
        context = Context(
            arm, duration, self._problem, action[None, :, None], rollout, lead[:, None], objective.system.gains.task
        )
        terms = {name: values[0] for name, values in weighted_terms(context).items()}
        position = tip.position[:, 0]
        distance = jnp.linalg.norm(position - self._problem.goal_position[:, 0])
        info = {**state.info, "lead": action[:3], "knots": state.info["knots"] + 1}
        # Brax's wrappers add metrics and information of their own.
        metrics = {**state.metrics, **terms, "distance": distance, "contact_force": after.contact_force}
        return state.replace(
            pipeline_state=after,
            obs=self._observe(after, position),
            reward=-sum(terms.values(), start=jnp.zeros(())),
            done=jnp.where(jnp.isfinite(after.q).all(), 0.0, 1.0),
            metrics=metrics,
            info=info,
        )

    def _observe(self, state: State, position: jax.Array) -> jax.Array:
        hinges = self._loop.hinges
        to_target = self._problem.goal_position[:, 0] - position
        return jnp.concatenate([state.q[hinges], state.qd[hinges], position, to_target, state.link_force])


envs.register_environment(NAME, ContactReach)
