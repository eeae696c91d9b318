"""Closed-loop runs that keep every planning problem, so that benchmarks measure on problems that really occur."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from contact_reach_ros.baselines.method import ReferenceMethod
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.planning.cost import Problem
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.cma_es import Distribution
from contact_reach_ros.planning.solver.hybrid import CostFunction, HybridSolver, Solution
from contact_reach_ros.plant.plant import TICK, Plant
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import Scene, SceneFile
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

NOTICEABLE_FORCE = 0.1
"""N."""

_TICK_NS = int(TICK * NANOSECONDS)


@dataclass(frozen=True, eq=False)
class Solve:
    """One call of the solver: what it was given, what it found and how long that took."""

    problem: Problem
    distribution: Distribution
    start_cost: float
    number: int
    seconds: float
    cpu_seconds: float
    solution: Solution


@dataclass(frozen=True, eq=False)
class Request:
    """What a planner was asked."""

    q: Array
    v: Array
    state_ns: int
    effect_ns: int
    goal: Goal
    spheres: Spheres


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
    """m, flange."""
    rotation: float
    """rad, flange."""
    joints: float
    """rad, the largest over the joints."""


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
        self,
        problem: Problem,
        distribution: Distribution,
        start_cost: float,
        number: int,
        until: float = math.inf,
    ) -> Solution:
        cpu, wall = time.process_time(), time.perf_counter()
        solution = super().solve(problem, distribution, start_cost, number, until)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.last = Solve(problem, distribution, start_cost, number, wall, cpu, solution)
        return solution


class RecordingPlanner(RecedingHorizonPlanner):
    """The planner under test; it keeps what it is asked and how long it takes."""

    _solver: _RecordingSolver

    def __init__(
        self, settings: PlanningSettings, gains: ImpedanceSettings, permitted_force: float, capacity: int
    ) -> None:
        super().__init__(settings, gains, permitted_force, capacity)
        self.recorded: list[RecordedPlan] = []

    def plan(self, q: ArrayLike, v: ArrayLike, state_ns: int, effect_ns: int, goal: Goal, spheres: Spheres) -> Plan:
        """As the planner does, and remember it."""
        first = self._memory is None
        cpu, wall = time.process_time(), time.perf_counter()
        plan = super().plan(q, v, state_ns, effect_ns, goal, spheres)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        request = Request(np.array(q), np.array(v), state_ns, effect_ns, goal, spheres)
        self.recorded.append(RecordedPlan(request, plan, self._solver.last, first, wall, cpu))
        return plan

    def _make_solver(self, cost: CostFunction[Problem]) -> _RecordingSolver:
        return _RecordingSolver(cost, len(self._bounds), self._settings)


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
    method = ReferenceMethod(planner, ControllerSettings())
    while sum(not plan.first for plan in recorded) < plans or len(scenes) < episodes:
        scene = make_scene(file, seed + len(scenes))
        scenes.append(scene)
        planner.recorded.clear()
        path: list[Array] = []

        def watch(tick: int, plant: Plant, path: list[Array] = path) -> None:
            path.append(plant.data.qpos[: iiwa14.N_JOINTS].copy())

        result = run_episode(scene, method, options, watch)
        reached += result.reached
        recorded += planner.recorded
        # After tick t the plant stands at the instant of tick t + 1.
        errors += [
            _prediction_error(entry.plan, path[index])
            for entry in planner.recorded
            if (index := entry.plan.effect_ns // _TICK_NS - 1) < len(path)
        ]
    return RecordedRuns(scenes, recorded, errors, reached)


def _prediction_error(plan: Plan, q: Array) -> PredictionError:
    expected_q = plan.predicted_q[0]
    expected, actual = link_frames(expected_q), link_frames(q)
    turned = Rotation.from_matrix(actual[0][-1] @ expected[0][-1].T)
    return PredictionError(
        position=float(np.linalg.norm(actual[1][-1] - expected[1][-1])),
        rotation=float(turned.magnitude()),
        joints=float(np.abs(q - expected_q).max()),
    )
