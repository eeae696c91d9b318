"""The environment `contact_reach` of Brax: a scene, law (3) inside, and cost (5) as negative reward.

Importing this module makes the environment known to `brax.envs.get_environment`.
"""

from __future__ import annotations

import dataclasses

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax import envs
from brax.envs.base import PipelineEnv, State

from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.planning.brax_pipeline import ClosedLoop, bodies_and_fields
from contact_reach_ros.planning.collisions import nearest_bodies
from contact_reach_ros.planning.objectives import knot_bounds, make_objective, planned
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.planning.problem import Problem, Rollout
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Context, term_weights, weighted_terms
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import load_system
from contact_reach_ros.planning.transfer.pipeline import Pose
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import obstacle_spheres, rest_positions, sphere_capacity

NAME = "contact_reach"


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
        bodies, fields = bodies_and_fields(obstacles)
        sys = load_system(build_mjcf(arm, obstacles=bodies, fields=fields))
        sys = sys.tree_replace({"opt.timestep": settings.knot_duration / settings.substeps})
        super().__init__(sys, "generalized", settings.substeps)
        settings = dataclasses.replace(settings, pipeline="closed_loop", null_space="planned", horizon=1)
        self._backend, self._pipeline = NAME, ClosedLoop(make_objective(arm, settings, gains))
        self._kernel = self._pipeline.kernel(sys)
        self._planned = np.flatnonzero(planned(arm, settings, gains))
        self._bounds = jnp.asarray(knot_bounds(arm, settings)[self._planned], jnp.float32)
        self._start = jnp.zeros(sys.q_size()).at[self._kernel.hinges].set(scene.start)
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
            joint_limit_margin=single(settings.joint_limit_margin),
            clearance_margin=single(settings.clearance_margin),
            bodies=nearest_bodies(arm, scene.start, scene.environment),
        )

    @property
    def action_size(self) -> int:
        """The variables of a knot, in units of their bounds γ: Δx and Δq, without what has no effect."""
        return len(self._bounds)

    def reset(self, rng: jax.Array) -> State:
        """The start of the scene, at rest."""
        hinges = self._kernel.hinges
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
        return State(pipeline_state, observation, zero, zero, metrics, info)

    def step(self, state: State, action: jax.Array) -> State:
        """One knot; `action` is clipped to [-1, 1]."""
        before, objective = state.pipeline_state, self._kernel.objective
        scaled = jnp.clip(action, -1.0, 1.0) * self._bounds
        action = jnp.zeros(objective.system.action_size).at[self._planned].set(scaled)
        after = self.pipeline_step(before, action)
        q = jnp.stack([before.q, after.q])[:, self._kernel.hinges, None]
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

    def _observe(self, state: brax.State, position: jax.Array) -> jax.Array:
        hinges = self._kernel.hinges
        to_target = self._problem.goal_position[:, 0] - position
        return jnp.concatenate([state.q[hinges], state.qd[hinges], position, to_target, state.link_force])


envs.register_environment(NAME, ContactReach)
