"""The paper's comparison in Section V-B: planning joint torques instead of references of the control law.

The same cost, the same solver and the same stop rule, but the decision variables are the torques τ_t of (4c) beyond
C + g, which is known, and no law stands between plan and arm. The paper does not say for how long a torque is held. Law
(3) changes its torque as fast as its poles, the fastest of which decays in 11 ms; a torque that stays the same for a
knot of 0.1 s would leave an undamped arm on its own for as long as the law needs to settle. So there is one torque
vector per step of the transfer model, 25 ms by default: 84 variables instead of 39. Their bounds are the largest torque
that the law can ask for at rest with actions within γ, so that both planners may accelerate the arm alike.

Both plan against the transfer model itself: from each start, a plan is made, its first knot is carried out, the plan is
shifted by one knot, and so on, as in (4).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.law import ImpedanceLaw
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, Problem, Rollout
from contact_reach_ros.planning.objectives import action_bounds, make_objective
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import fresh
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.closed_loop import Reference, driven_acceleration
from contact_reach_ros.planning.transfer.contact import contact_step
from contact_reach_ros.planning.transfer.dynamics import arm_dynamics
from contact_reach_ros.planning.transfer.kinematics import link_frames
from contact_reach_ros.planning.transfer.lanes import make_keep, single
from contact_reach_ros.planning.transfer.pipeline import MAX_JOINT_SPEED, N_ACTION, State
from contact_reach_ros.planning.warm_start import shift_distribution, shift_solution
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TorqueObjective(Objective):
    """Cost (5) of joint torques: actions are (H, 7 * substeps, B), N m, step after step."""

    def roll_out(self, problem: Problem, actions: jax.Array) -> Rollout:
        """Run the transfer model without the laws under the actions, knot by knot."""
        start = _start(self, problem, actions.shape[-1])
        pose = pipeline.flange_pose(self.system, start)

        def knot(state: State, action: jax.Array) -> tuple[State, tuple]:
            state, link_force = self.advance(state, action)
            pose = pipeline.flange_pose(self.system, state)
            contact = jax.vmap(self._measure)(link_force)
            return state, (state.q, pose, link_force.max(axis=0), contact.max(axis=0))

        _, (q, poses, link_force, contact) = jax.lax.scan(knot, start, actions)
        poses = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), pose, poses)
        # There are no references; the cost does not look at them.
        reference = Reference(poses.position[:-1], poses.rotation[:-1], q)
        return Rollout(jnp.concatenate([start.q[None], q]), poses, reference, link_force, contact)

    def terms(self, problem: Problem, actions: jax.Array, rollout: Rollout) -> dict[str, jax.Array]:
        """As for references, less the cost of Δq, which does not exist."""
        weights = problem.weights._replace(null_motion=0.0)
        return super().terms(problem._replace(weights=weights), actions, rollout)

    def advance(self, state: State, action: jax.Array) -> tuple[State, jax.Array]:
        """State after one knot under an action (7 * substeps, B), and the forces (substeps, 6, B) on the links."""

        def step(state: State, torque: jax.Array) -> tuple[State, jax.Array]:
            state = self._step(state, torque)
            return state, state.link_force

        torques = action.reshape(self.substeps, iiwa14.N_JOINTS, -1)
        return jax.lax.scan(step, state, torques)

    def _step(self, state: State, torque: jax.Array) -> State:
        """As `pipeline.step`, with given torques (7, B)."""
        system, timestep = self.system, self.system.timestep
        keep = make_keep(state.q)
        q = state.q + (0.5 * timestep) * state.qd
        frames = link_frames(system.arm, q, keep)
        obstacles, link_force = state.obstacles, state.link_force
        if obstacles is not None:
            contact = contact_step(system.arm, frames, obstacles, system.contact_stiffness, timestep, keep)
            obstacles, link_force = obstacles._replace(center=contact.center), contact.link_force
            torque = torque + contact.joint_torque
        acceleration = driven_acceleration(arm_dynamics(system.arm, frames, keep), torque)
        qd = jnp.clip(state.qd + timestep * acceleration, -MAX_JOINT_SPEED, MAX_JOINT_SPEED)
        return State(q + (0.5 * timestep) * qd, qd, obstacles, link_force)


def torque_bounds(settings: PlanningSettings, gains: ImpedanceSettings, q: Array) -> Array:
    """Largest torque (7,) beyond C + g that law (3) can ask for at rest at `q` (7,) with actions within γ, N m."""
    model = RobotModel()
    rest = np.zeros(iiwa14.N_JOINTS)
    model.update(q, rest)
    law = ImpedanceLaw(gains)
    total = np.zeros(iiwa14.N_JOINTS)
    for variable, bound in enumerate(action_bounds(settings)[:N_ACTION]):
        action = np.zeros(N_ACTION)
        action[variable] = bound
        total += np.abs(law.torque(model, rest, -action[6:], -action[:6]))
    return np.minimum(total, iiwa14.TORQUE_LIMITS)


@dataclass(frozen=True)
class PlanningRecord:
    """What one way of planning took.

    Attributes
    ----------
    seconds, cpu_seconds, steps
        Of each plan: wall-clock and processor time of the solver, s, and its steps.
    variables
        Number of decision variables.
    approach
        How much nearer to its goal the flange came from each start, m.
    """

    seconds: list[float]
    cpu_seconds: list[float]
    steps: list[int]
    variables: int
    approach: list[float]


class _Planning:
    """One way of planning, with what it has done so far."""

    def __init__(
        self,
        objective: Objective,
        advance: Callable[[State, jax.Array], tuple[State, jax.Array]],
        bounds: Array,
        settings: PlanningSettings,
    ) -> None:
        self.bounds = np.tile(bounds, settings.horizon)
        self._settings = settings
        self._spread = np.full_like(self.bounds, settings.sigma)
        size = len(bounds)

        def actions(points: jax.Array) -> jax.Array:
            return (points * self.bounds[:, None]).reshape(settings.horizon, size, -1)

        def cost(problem: Problem, points: jax.Array) -> jax.Array:
            return objective.cost(problem, actions(points))

        def first_knot(problem: Problem, point: jax.Array) -> Problem:
            state, _ = advance(_start(objective, problem, 1), actions(point[:, None])[0])
            return problem._replace(q=state.q, v=state.qd, obstacles=state.obstacles)

        def distance(problem: Problem) -> jax.Array:
            position = pipeline.flange_pose(objective.system, _start(objective, problem, 1)).position
            return jnp.linalg.norm(position - problem.goal_position)

        self._solver: HybridSolver[Problem] = HybridSolver(cost, len(self.bounds), settings)
        self._cost = jax.jit(cost)
        self._first_knot = jax.jit(first_knot)
        self.distance = jax.jit(distance)
        self.record = PlanningRecord([], [], [], len(self.bounds), [])

    def run(self, problem: Problem, knots: int, timed: bool = True) -> None:
        """Plan and carry out `knots` knots from where a problem starts."""
        settings = self._settings
        still = np.zeros_like(self.bounds)
        initial = float(self.distance(problem))
        best: NDArray[np.floating] = still
        distribution = fresh(single(still), single(self._spread))
        for index in range(knots):
            points = np.stack([best, still], axis=1).astype(np.float32)
            costs = np.asarray(self._cost(problem, points))
            costs = np.where(np.isfinite(costs), costs, np.inf)
            start = points[:, int(np.argmin(costs))]
            cpu, wall = time.process_time(), time.perf_counter()
            solution = self._solver.solve(problem, distribution._replace(mean=single(start)), float(costs.min()), index)
            if timed:
                self.record.seconds.append(time.perf_counter() - wall)
                self.record.cpu_seconds.append(time.process_time() - cpu)
                self.record.steps.append(solution.steps)
            problem = self._first_knot(problem, single(solution.best))
            best = shift_solution(solution.best, settings.horizon, 1.0)
            distribution = shift_distribution(solution.distribution, best, self._spread, settings.horizon, 1.0)
        if timed:
            self.record.approach.append(initial - float(self.distance(problem)))


def compare_with_torques(
    settings: PlanningSettings, gains: ImpedanceSettings, starts: Sequence[Problem], knots: int
) -> dict[str, PlanningRecord]:
    """Plan references and joint torques from the same starts, alternately.

    Parameters
    ----------
    starts
        Problems at rest, with the same number of obstacles.
    knots
        How many knots to carry out from each.

    Returns
    -------
    What each way took, by the names 'references' and 'torques'.
    """
    references = make_objective(settings, gains)
    torques = TorqueObjective(references.system, references.horizon, references.substeps, references.contact_measure)

    def latched(state: State, action: jax.Array) -> tuple[State, jax.Array]:
        reference = pipeline.latch(state.q, pipeline.flange_pose(references.system, state), action)

        def step(state: State, _: None) -> tuple[State, jax.Array]:
            state = pipeline.step(references.system, state, reference)
            return state, state.link_force

        return jax.lax.scan(step, state, None, length=references.substeps)

    home = np.asarray(starts[0].q, dtype=float)[:, 0]
    limits = np.tile(torque_bounds(settings, gains, home), settings.substeps)
    ways = {
        "references": _Planning(references, latched, action_bounds(settings)[:N_ACTION], settings),
        "torques": _Planning(torques, torques.advance, limits, settings),
    }
    for way in ways.values():
        way.run(starts[0], 1, timed=False)  # compiles
    for start in starts:
        for way in ways.values():
            way.run(start, knots)
    return {name: way.record for name, way in ways.items()}


def _start(objective: Objective, problem: Problem, lanes: int) -> State:
    obstacles = problem.obstacles
    if obstacles is not None:
        obstacles = obstacles._replace(center=jnp.broadcast_to(obstacles.center, (*obstacles.center.shape[:2], lanes)))
    shape = (iiwa14.N_JOINTS, lanes)
    q, v = jnp.broadcast_to(problem.q, shape), jnp.broadcast_to(problem.v, shape)
    return pipeline.init(objective.system, q, v, obstacles)
