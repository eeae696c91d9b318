"""The paper's comparison in Section V-B: planning joint torques instead of references of the control law.

What torques are planned, and within which bounds, is said in `baselines.joint_torque`.
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

from contact_reach_ros.baselines.joint_torque import make_torque_objective, torque_bounds
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Objective, Problem
from contact_reach_ros.planning.objectives import action_bounds, make_objective
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import fresh
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.pipeline import N_ACTION, State
from contact_reach_ros.planning.warm_start import shift_distribution, shift_solution

Array = NDArray[np.float64]


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
            state, _ = advance(objective.start(problem, 1), actions(point[:, None])[0])
            return problem._replace(q=state.q, v=state.qd, obstacles=state.obstacles)

        def distance(problem: Problem) -> jax.Array:
            position = pipeline.flange_pose(objective.system, objective.start(problem, 1)).position
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
    torques = make_torque_objective(settings, gains)

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
