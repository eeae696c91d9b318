"""Law (6), the paper's comparison for the null space: plans of Δx alone, and a steady pull to one posture."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import Carry, Objective, ReferenceSpace
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Problem, Rollout
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.planning.transfer.pipeline import Pose, Reference


@dataclass(frozen=True, eq=False)
class PostureObjective(Objective):
    """Cost (5) where the same q_d is in force all the time: the posture that the problem has for detours."""

    posture: jax.Array | None = None
    """(n, 1) q_d of law (6), rad, while the model runs."""

    def run(self, problem: Problem, actions: jax.Array) -> tuple[Carry, Rollout]:
        """As for any plan, but with the posture of law (6)."""
        return super(PostureObjective, dataclasses.replace(self, posture=problem.detour)).run(problem, actions)

    def latch(self, q: jax.Array, v: jax.Array, pose: Pose, action: jax.Array) -> Reference:
        """As for any plan, but with the posture of law (6)."""
        posture = q if self.posture is None else jnp.broadcast_to(self.posture, q.shape)
        return super().latch(q, v, pose, action)._replace(posture=posture)


class PostureSpace(ReferenceSpace):
    """Decision variables: of each knot the rows of Δx that law (1) controls."""

    def __init__(self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings) -> None:
        super().__init__(arm, settings, gains)
        closed = self.objective
        self.objective = PostureObjective(closed.system, closed.horizon, closed.substeps)
        rows = self.objective.system.gains.rows
        self._planned = self._planned[:rows]
        self.bounds, self.spread = (
            values.reshape(settings.horizon, -1)[:, :rows].ravel() for values in (self.bounds, self.spread)
        )


class PosturePlanner(RecedingHorizonPlanner):
    """Plans Δx; law (6) pulls the redundant joints to the arm's reference posture."""

    _make_space = PostureSpace

    def _posture(self, request: Request) -> Array:
        """(n,) q_d of law (6), rad."""
        posture: Array = np.array(self._arm.default("reference_posture"))
        return posture

    def _problem(self, q: jax.Array, v: jax.Array, obstacles: Any, request: Request, *others: Any) -> Problem:
        problem, posture = super()._problem(q, v, obstacles, request, *others), self._posture(request)
        weights = problem.weights | {"detour": single(0.0)}
        return jax.device_put(problem._replace(detour=single(posture[:, None]), weights=weights))


class StartPlanner(PosturePlanner):
    """Plans Δx; law (6) pulls the redundant joints to where they were at the first plan."""

    _first: Array

    def _posture(self, request: Request) -> Array:
        if self.memory is None:
            self._first = request.q
        return self._first
