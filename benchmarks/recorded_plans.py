"""Plans of closed-loop runs with the problems that the solver was given, so that measurements are on real problems."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.baselines.method import Method
from benchmarks.episode import EpisodeOptions, run_episode
from contact_reach_ros.arm import Arm
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.plan import Plan, Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solution
from contact_reach_ros.planning.terms import Problem
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.scene_file import SceneFile
from contact_reach_ros.world.spheres import sphere_capacity

NOTICEABLE_FORCE = 0.1
"""N."""


@dataclass(frozen=True, eq=False)
class RecordedPlan:
    """One plan that started from the one before.

    Attributes
    ----------
    scene
        That it was made in.
    problem, start, start_cost
        What the solver was given: the problem, where the search begins, and the cost there.
    best
        (N,) the point that it found.
    """

    scene: Scene
    request: Request
    plan: Plan
    problem: Problem
    start: FloatArray
    start_cost: float
    best: np.ndarray

    @property
    def touches(self) -> bool:
        """Whether the plan expects noticeable contact."""
        return bool(self.plan.predicted_contact_forces.max() > NOTICEABLE_FORCE)


class _RecordingSolver(HybridSolver):
    """Remembers its last call."""

    last: tuple[Problem, FloatArray, float, np.ndarray]

    def solve(
        self, problem: Problem, start: FloatArray, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        solution = super().solve(problem, start, start_cost, number, until)
        self.last = problem, start, start_cost, solution.best
        return solution


class _RecordingPlanner(RecedingHorizonPlanner):
    """The planner; it keeps what its solver was given for each plan that started from the one before."""

    def __init__(self, arm: Arm, settings: PlanningSettings, permitted_force: float, capacity: int) -> None:
        def make(cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> _RecordingSolver:
            self._recording = _RecordingSolver(cost, spread, settings)
            return self._recording

        super().__init__(arm, settings, ControllerSettings(), permitted_force, capacity, solver=make)
        self.recorded: list[tuple[Request, Plan, Problem, FloatArray, float, np.ndarray]] = []

    def plan(self, request: Request) -> Plan:
        """As the planner does, and keep it."""
        is_first = self.memory is None
        plan = super().plan(request)
        if not is_first:
            request = request._replace(q=np.array(request.q), v=np.array(request.v))
            self.recorded.append((request, plan, *self._recording.last))
        return plan


def record_plans(
    arm: Arm, file: SceneFile, settings: PlanningSettings, count: int, seed: int = 0, episodes: int = 1
) -> list[RecordedPlan]:
    """Warm-started plans of episodes with the seeds `seed`, `seed` + 1, ..., spread evenly over them.

    Half of them expect contact if there are that many.

    Parameters
    ----------
    settings
        Of the planner, which is compiled here.
    count
        How many; the episodes have four times as many.
    episodes
        Least number of episodes that the plans come from.
    """
    budget = load_budget()
    planner = _RecordingPlanner(arm, settings, budget.permitted_force, sphere_capacity(file))
    planner.warm_up(lambda line: None)
    method = Method(planner, ControllerSettings())
    found: list[RecordedPlan] = []
    run = 0
    while len(found) < 4 * count or run < episodes:
        scene = make_scene(file, arm, seed + run)
        planner.recorded.clear()
        run_episode(scene, method, EpisodeOptions(budget=budget))
        found += [RecordedPlan(scene, *entry) for entry in planner.recorded]
        run += 1
    touching = [plan for plan in found if plan.touches]
    others = [plan for plan in found if not plan.touches]
    with_contact = min(len(touching), max(count // 2, count - len(others)))
    return _evenly(touching, with_contact) + _evenly(others, count - with_contact)


def _evenly(plans: Sequence[RecordedPlan], count: int) -> list[RecordedPlan]:
    return [plans[index] for index in np.linspace(0, len(plans) - 1, count).astype(int)] if count else []
