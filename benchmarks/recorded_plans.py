"""Closed-loop runs that keep every planning problem, so that benchmarks measure on problems that really occur."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from benchmarks.baselines.method import Method
from benchmarks.episode import EpisodeOptions, run_episode
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.problem import Problem
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import Distribution
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import CostFunction, Solution
from contact_reach_ros.simulation.plant import TICK, Plant
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.world.generate import make_scene
from contact_reach_ros.world.scene import Scene, SceneFile

NOTICEABLE_FORCE = 0.1
"""N."""

_TICK_NS = int(TICK * NANOSECONDS)


@dataclass(frozen=True, eq=False)
class Solve:
    """One call of the solver: what it was given, what it found and how long that took."""

    problem: Problem
    state: Distribution
    start_cost: float
    number: int
    seconds: float
    cpu_seconds: float
    solution: Solution


@dataclass(frozen=True, eq=False)
class RecordedPlan:
    """One plan of a run.

    Attributes
    ----------
    first
        Whether it is the first one of its run, which has nothing to start from.
    wall_s, cpu_s
        Time of the whole call, s.
    """

    request: Request
    plan: Plan
    solve: Solve
    first: bool
    wall_s: float
    cpu_s: float

    @property
    def touches(self) -> bool:
        """Whether the plan expects noticeable contact."""
        return bool(self.plan.predicted_contact_forces.max() > NOTICEABLE_FORCE)


@dataclass(frozen=True)
class PredictionError:
    """Where the arm really was when a plan took effect, less where the planner had expected it."""

    position: float
    """Of the tip, m."""
    rotation: float
    """Of the tip, rad."""
    joints: float
    """Largest over the joints, rad."""


@dataclass(frozen=True, eq=False)
class RecordedRuns:
    """Closed-loop runs of one scene."""

    scenes: list[Scene]
    plans: list[RecordedPlan]
    errors: list[PredictionError]
    reached: int

    @property
    def warm(self) -> list[RecordedPlan]:
        """The plans that started from the one before."""
        return [recorded for recorded in self.plans if not recorded.first]


class _RecordingSolver(HybridSolver[Problem]):
    """Remembers its last call."""

    last: Solve

    def solve(
        self, problem: Problem, state: Distribution, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        cpu, wall = time.process_time(), time.perf_counter()
        solution = super().solve(problem, state, start_cost, number, until)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.last = Solve(problem, state, start_cost, number, wall, cpu, solution)
        return solution


class RecordingPlanner(RecedingHorizonPlanner):
    """The planner under test; it keeps requests, plans and how long they take."""

    def __init__(
        self, arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings, permitted_force: float, capacity: int
    ) -> None:
        def make(cost: CostFunction[Any], n: int, settings: PlanningSettings) -> _RecordingSolver:
            self._recording = _RecordingSolver(cost, n, settings)
            return self._recording

        super().__init__(arm, settings, gains, permitted_force, capacity, solver=make)
        self.arm = arm
        self.solver: HybridSolver[Problem] = self._recording
        self.recorded: list[RecordedPlan] = []

    def plan(self, request: Request) -> Plan:
        """As the planner does, and remember it."""
        first = self.memory is None
        cpu, wall = time.process_time(), time.perf_counter()
        plan = super().plan(request)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        request = request._replace(q=np.array(request.q), v=np.array(request.v))
        self.recorded.append(RecordedPlan(request, plan, self._recording.last, first, wall, cpu))
        return plan


def record_runs(
    planner: RecordingPlanner, file: SceneFile, plans: int, seed: int, options: EpisodeOptions, episodes: int = 1
) -> RecordedRuns:
    """Run episodes with the seeds `seed`, `seed` + 1, ... until there are `plans` warm-started plans.

    Parameters
    ----------
    planner
        Warmed up, with room for the scene's obstacles.
    episodes
        Least number of episodes that the plans come from.
    """
    scenes: list[Scene] = []
    recorded: list[RecordedPlan] = []
    errors: list[PredictionError] = []
    reached = 0
    method = Method(planner, ControllerSettings())
    while sum(not plan.first for plan in recorded) < plans or len(scenes) < episodes:
        scene = make_scene(file, planner.arm, seed + len(scenes))
        scenes.append(scene)
        planner.recorded.clear()
        path: list[Array] = []

        def watch(tick: int, plant: Plant, path: list[Array] = path) -> None:
            path.append(plant.data.qpos[: planner.arm.n].copy())

        result = run_episode(scene, method, options, watch)
        reached += result.reached
        recorded += planner.recorded
        # After tick t the plant stands at the instant of tick t + 1.
        errors += [
            _prediction_error(planner.arm, entry.plan, path[index])
            for entry in planner.recorded
            if (index := entry.plan.effect_ns // _TICK_NS - 1) < len(path)
        ]
    return RecordedRuns(scenes, recorded, errors, reached)


def spread_states(plans: Sequence[RecordedPlan], count: int) -> list[RecordedPlan]:
    """`count` plans, half of them with contact if there are that many, evenly over the runs."""
    touching = [plan for plan in plans if plan.touches]
    others = [plan for plan in plans if not plan.touches]
    with_contact = min(len(touching), max(count // 2, count - len(others)))
    return _evenly(touching, with_contact) + _evenly(others, count - with_contact)


def _evenly(plans: Sequence[RecordedPlan], count: int) -> list[RecordedPlan]:
    return [plans[index] for index in np.linspace(0, len(plans) - 1, count).astype(int)] if count else []


def _prediction_error(arm: Arm, plan: Plan, q: Array) -> PredictionError:
    expected_q = plan.predicted_q[0]
    expected, actual = link_frames(arm, expected_q), link_frames(arm, q)
    turned = Rotation.from_matrix(actual[0][-1] @ expected[0][-1].T)
    return PredictionError(
        position=float(np.linalg.norm(actual[1][-1] - expected[1][-1])),
        rotation=float(turned.magnitude()),
        joints=float(np.abs(q - expected_q).max()),
    )
