"""Collision-free paths in joint space: RRT* of the Open Motion Planning Library (OMPL)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.baselines.clearance import ClearanceChecker
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

_NEAR_START = 0.5
"""Standard deviation of the seeds around the start, rad; the other half of them is drawn from all postures."""

_MAX_SIMPLIFICATION = 5.0
"""s; usually it ends by itself after a fraction of that."""


@dataclass(frozen=True)
class PathSettings(Settings):
    """The problem that RRT* is given, and how long it may work on it."""

    clearance: float = setting(0.02, "distance to keep from obstacles", unit="m", minimum=0.0, maximum=0.2)
    resolution: float = setting(
        0.02, "greatest motion of any point of the arm between two checks", unit="m", minimum=0.001, maximum=0.2
    )
    joint_margin: float = setting(
        0.15, "distance to keep from the joints' position limits", unit="rad", minimum=0.0, maximum=0.5
    )
    goal_samples: int = setting(
        2000, "postures from which inverse kinematics looks for goals", minimum=1, maximum=1_000_000
    )
    max_goals: int = setting(40, "goal postures handed to RRT*", minimum=1, maximum=10_000)
    searches: int = setting(
        6, "runs of RRT* from scratch, of which the shortest path is taken", minimum=1, maximum=1000
    )
    iterations: int = setting(500, "of RRT* in each run", minimum=1, maximum=10_000_000)
    time_limit: float = setting(
        60.0,
        "wall-clock time after which RRT* stops, so that it ends on any machine; the same paths come out only if it "
        "ends before",
        unit="s",
        minimum=0.1,
        maximum=3600.0,
    )
    informed: bool = setting(True, "once there is a path, look only where a shorter one can be")
    simplify: bool = setting(True, "shorten and smooth the path of each run")
    max_step: float = setting(1.5, "longest edge of the tree", unit="rad", minimum=0.05, maximum=20.0)


@dataclass(frozen=True, eq=False)
class JointPath:
    """A path and how it was found.

    Attributes
    ----------
    postures
        (P, n) corners, from the start to a goal, rad.
    raw_length
        Length of this path before it was simplified, rad.
    goals
        Number of goal postures that RRT* was given.
    iterations
        Of RRT*, of all runs together.
    checks
        Number of straight motions that were checked.
    seconds
        Wall-clock time of the whole search, s.
    """

    postures: Array
    raw_length: float
    goals: int
    iterations: int
    checks: int
    seconds: float

    @property
    def length(self) -> float:
        """In joint space, rad."""
        return path_length(self.postures)


def path_length(postures: Array) -> float:
    """Length in joint space of the path through postures (P, n), rad."""
    return float(np.linalg.norm(np.diff(postures, axis=0), axis=1).sum())


def find_path(arm: Arm, start: Array, goal: Target, spheres: Spheres, settings: PathSettings, seed: int) -> JointPath:
    """The shortest collision-free path in joint space that RRT* finds to any posture with the tip at the goal.

    The same arguments give the same path unless `settings.time_limit` ends the search.

    Parameters
    ----------
    start
        (n,) joint angles, rad.
    goal
        Of the tip.
    spheres
        Obstacles, where they are now; they are taken to stay there.
    seed
        Of all random numbers.

    Raises
    ------
    PlanningError
        If the start touches an obstacle or lies at a joint limit, no collision-free posture at the goal was found, no
        path to one was, or OMPL is not installed.
    """
    begin = time.perf_counter()
    lower, upper = joint_bounds(arm, settings)
    if ((start < lower) | (start > upper)).any():
        raise PlanningError(
            f"q = {np.round(start, 3).tolist()}: expected every joint at least {settings.joint_margin:g} rad from its "
            "limits, where a collision-free path can start; withdraw the arm first"
        )
    checker = ClearanceChecker(arm, spheres, settings.clearance, settings.resolution, start)
    goals = goal_postures(start, goal, checker, settings, np.random.default_rng(seed))
    # No path is shorter than this.
    bound = float(np.linalg.norm(goals - start, axis=1).min())
    until = begin + settings.time_limit
    best: tuple[Array, float] | None = None
    iterations = checks = 0
    for index in range(settings.searches):
        search = _Search(start, goals, checker, settings)
        found = search.run(seed * settings.searches + index + 1, until)
        iterations, checks = iterations + search.iterations, checks + search.checks
        if found is not None and (best is None or path_length(found[0]) < path_length(best[0])):
            best = found
        if time.perf_counter() > until or (best is not None and path_length(best[0]) <= bound + 1e-6):
            break
    if best is None:
        raise PlanningError(
            f"no collision-free path to any of {len(goals)} goal postures after {iterations} iterations of RRT*; "
            f"more (now {settings.searches} x {settings.iterations}, {settings.time_limit:g} s) or a method that "
            "allows contact may find a way"
        )
    return JointPath(*best, len(goals), iterations, checks, time.perf_counter() - begin)


def goal_postures(
    start: Array, goal: Target, checker: ClearanceChecker, settings: PathSettings, random: np.random.Generator
) -> Array:
    """Postures (G, n) with the tip at the goal that keep clear, at most `settings.max_goals`.

    The nearer half are the ones nearest to the start, the others any.

    Raises
    ------
    PlanningError
        If there are none among `settings.goal_samples`.
    """
    solutions = goal_candidates(checker.arm, start, goal, settings, random)
    distances = checker.distances(solutions)
    found = solutions[checker.free(solutions)]
    if not len(found):
        where = f"{np.round(goal.position, 3).tolist()} m, orientation {'free' if goal.rotation is None else 'held'}"
        best = f", {1e3 * distances.max():.1f} mm at best" if len(solutions) else ""
        raise PlanningError(
            f"no collision-free posture at the goal {where}: {len(solutions)} of {settings.goal_samples} samples reach "
            f"it, none with a clearance of {1e3 * settings.clearance:g} mm{best}; a method that allows contact may"
        )
    order = np.argsort(np.linalg.norm(found - start, axis=1), kind="stable")
    nearest, others = np.split(order, [settings.max_goals - settings.max_goals // 2])
    return found[np.concatenate([nearest, random.permutation(others)[: settings.max_goals // 2]])]


def goal_candidates(arm: Arm, start: Array, goal: Target, settings: PathSettings, random: np.random.Generator) -> Array:
    """Postures (N, n) with the tip at the goal, whatever is in the way."""
    near = start + _NEAR_START * random.standard_normal((settings.goal_samples // 2, arm.n))
    anywhere = random.uniform(*joint_bounds(arm, settings), (settings.goal_samples - len(near), arm.n))
    return solve_ik(arm, goal.position, goal.rotation, np.concatenate([near, anywhere]), settings.joint_margin)


def joint_bounds(arm: Arm, settings: PathSettings) -> tuple[Array, Array]:
    """Least and greatest joint angles (n,) of paths, rad."""
    return np.array(arm.lower) + settings.joint_margin, np.array(arm.upper) - settings.joint_margin


class _Search:
    """One run of RRT* and of OMPL's path simplification."""

    def __init__(self, start: Array, goals: Array, checker: ClearanceChecker, settings: PathSettings) -> None:
        self.iterations = self.checks = 0
        self._start, self._goals, self._checker, self._settings = start, goals, checker, settings

    def run(self, seed: int, until: float) -> tuple[Array, float] | None:
        """Postures (P, n) of the path and its length before simplification; None if there is none.

        `seed` is positive; `until` is an instant of `time.perf_counter`.
        """
        base, geometric, util = _ompl()
        with _quiet(util):
            util.RNG.setSeed(seed)  # from which OMPL draws the seeds of all that is made below
            n = len(self._start)
            space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
            for joint, (low, high) in enumerate(zip(*joint_bounds(self._checker.arm, self._settings), strict=True)):
                bounds.setLow(joint, low)
                bounds.setHigh(joint, high)
            space.setBounds(bounds)
            information = base.SpaceInformation(space)
            information.setStateValidityChecker(lambda state: bool(self._checker.free(self._posture(state)[None])[0]))
            information.setMotionValidator(self._motion_validator(base, information))
            information.setup()

            def state(posture: Array) -> Any:
                made = information.allocState()
                made[0:n] = posture.tolist()
                return made

            goal = base.GoalStates(information)
            for posture in self._goals:
                goal.addState(state(posture))
            objective = base.PathLengthOptimizationObjective(information)
            problem = base.ProblemDefinition(information)
            problem.addStartState(state(self._start))
            problem.setGoal(goal)
            problem.setOptimizationObjective(objective)
            planner = geometric.RRTstar(information)
            planner.setRange(self._settings.max_step)
            # Converges in a fraction of the iterations.
            planner.setInformedSampling(self._settings.informed)
            planner.setProblemDefinition(problem)
            planner.setup()

            def finished() -> bool:
                return planner.numIterations() >= self._settings.iterations or time.perf_counter() > until

            planner.solve(base.PlannerTerminationCondition(finished))
            self.iterations = planner.numIterations()
            if not problem.hasExactSolution():
                return None
            path = problem.getSolutionPath()
            raw_length = float(path.length())
            if self._settings.simplify:
                geometric.PathSimplifier(information, goal, objective).simplify(path, _MAX_SIMPLIFICATION, True)
            # Plain arrays only: OMPL's objects are freed here, all at once.
            return np.array([self._posture(state) for state in path.getStates()]), raw_length

    def _motion_validator(self, base: ModuleType, information: Any) -> Any:
        """Checks whole motions at once, which is what makes checks from Python fast enough."""
        search = self

        class MotionValidator(base.MotionValidator):  # type: ignore[name-defined, misc]
            def checkMotion(self, start: Any, end: Any) -> bool:  # noqa: N802
                search.checks += 1
                return search._checker.motion_free(search._posture(start), search._posture(end))

        return MotionValidator(information)

    def _posture(self, state: Any) -> Array:
        return np.array(state[0 : len(self._start)])


def _ompl() -> tuple[ModuleType, ModuleType, ModuleType]:
    """OMPL's modules; imported when first needed, since nothing else in the package uses them."""
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise PlanningError(
            f"collision-free paths need OMPL, which cannot be imported ({error}): in a checkout, pip "
            "install -c constraints.txt '.[benchmarks]', or leave the method collision_free out"
        ) from error
    return base, geometric, util


@contextmanager
def _quiet(util: ModuleType) -> Iterator[None]:
    """Without OMPL's messages: it would report every search, and every seed as one that comes too late."""
    level = util.getLogLevel()
    util.setLogLevel(util.LogLevel.LOG_NONE)
    try:
        yield
    finally:
        util.setLogLevel(level)
