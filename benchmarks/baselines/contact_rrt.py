"""A sampling planner that knows of contact: transition-based RRT whose cost is the predicted force.

The search is that of Jaillet, Cortés and Siméon (2010): a step up in cost is taken with a probability that falls with
the step, and the temperature follows how often steps are refused. As in contact-aware sampling planners
(arXiv 2308.04323) a posture's cost is the contact force in it, and forces above the permitted one are forbidden.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.baselines.clearance import ClearanceChecker
from benchmarks.baselines.rrt_star import (
    JointPath,
    PathSettings,
    goal_candidates,
    joint_bounds,
    path_length,
)
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.paths import Statics, levers
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres


@dataclass(frozen=True)
class ContactRrtSettings(Settings):
    """The search, and the time that it may take."""

    iterations: int = setting(4000, "greatest number of samples", minimum=1, maximum=10_000_000)
    goal_share: float = setting(0.25, "share of the samples that are goal postures", minimum=0.0, maximum=1.0)
    max_step: float = setting(0.3, "length of an edge of the tree", unit="rad", minimum=0.01, maximum=5.0)
    temperature_factor: float = setting(
        2.0,
        "by which the temperature rises after `patience` refusals, and falls after a step up",
        minimum=1.01,
        maximum=10.0,
    )
    patience: int = setting(10, "refusals in a row before it rises", minimum=1, maximum=10_000)
    shortcuts: int = setting(
        200, "random shortcuts tried on the path, none of which may press harder", minimum=0, maximum=100_000
    )


def find_contact_path(
    arm: Arm,
    start: Array,
    goal: Target,
    spheres: Spheres,
    permitted_force: float,
    seed: int,
    settings: ContactRrtSettings | None = None,
) -> JointPath:
    """A path in joint space along which no predicted force exceeds `permitted_force`, N, and few are large.

    Raises
    ------
    PlanningError
        If no posture at the goal, or no path to one, keeps below the permitted force.
    """
    begin, settings, random = time.perf_counter(), settings or ContactRrtSettings(), np.random.default_rng(seed)
    search = _Search(arm, spheres, permitted_force, start, goal, settings, random)
    goals = goal_candidates(arm, start, goal, PathSettings(), random)
    forces = search.force(goals) if len(goals) else np.zeros(0)
    goals = goals[(forces <= permitted_force) & search.rigid.free(goals)] if len(goals) else goals
    if not len(goals):
        best = f", {forces.min():.1f} N at best" if len(forces) else ""
        raise PlanningError(
            f"no posture at the goal {np.round(goal.position, 3).tolist()} m within {permitted_force:g} N{best}"
        )
    order = np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")
    goals = goals[order][: PathSettings().max_goals]
    path = search.run(goals)
    if path is None:
        raise PlanningError(f"no path within {permitted_force:g} N to any of {len(goals)} postures at the goal")
    raw = path_length(path)
    path = search.shorten(path)
    return JointPath(path, raw, len(goals), search.iterations, search.checks, time.perf_counter() - begin)


class _Search:
    """One run of the transition-based RRT."""

    def __init__(
        self,
        arm: Arm,
        spheres: Spheres,
        permitted_force: float,
        start: Array,
        goal: Target,
        settings: ContactRrtSettings,
        random: np.random.Generator,
    ) -> None:
        self.force = Statics(arm, spheres, start, goal).forces
        self.rigid = ClearanceChecker(arm, Spheres.none(spheres.environment), 0.0, PathSettings().resolution, start)
        self.iterations = self.checks = 0
        self._arm, self._permitted, self._settings, self._random = arm, permitted_force, settings, random
        self._lower, self._upper = joint_bounds(arm, PathSettings())
        self._start = start
        self._temperature, self._refusals = 0.1, 0

    def run(self, goals: Array) -> Array | None:
        """Postures (P, n) of a path from the start to one of the goals (G, n); None if there is none."""
        settings, random = self._settings, self._random
        nodes, parents, forces = [self._start], [-1], [float(self.force(self._start[None])[0])]
        for self.iterations in range(1, settings.iterations + 1):
            is_goal = random.uniform() < settings.goal_share
            sample = goals[random.integers(len(goals))] if is_goal else random.uniform(self._lower, self._upper)
            nearest = int(np.linalg.norm(np.array(nodes) - sample, axis=1).argmin())
            # Towards a goal as far as it goes; elsewhere one step.
            while True:
                way = sample - nodes[nearest]
                length = float(np.linalg.norm(way))
                new = nodes[nearest] + way * min(1.0, settings.max_step / max(length, 1e-12))
                along = self._along(nodes[nearest], new)
                force = None if along is None else float(along.max())
                if force is None or not self._takes(forces[nearest], force, length):
                    break
                nodes.append(new)
                parents.append(nearest)
                forces.append(float(self.force(new[None])[0]))
                nearest = len(nodes) - 1
                if is_goal and length <= settings.max_step:
                    path = [nearest]
                    while parents[path[-1]] >= 0:
                        path.append(parents[path[-1]])
                    return np.array([nodes[index] for index in reversed(path)])
                if not is_goal:
                    break
        return None

    def shorten(self, path: Array) -> Array:
        """The path with random shortcuts that press no harder than what they replace."""
        for _ in range(self._settings.shortcuts):
            if len(path) < 3:
                break
            first, last = sorted(self._random.choice(len(path), 2, replace=False))
            if last - first < 2:
                continue
            along = self._along(path[first], path[last])
            if along is None:
                continue
            replaced = [self._along(a, b) for a, b in zip(path[first:last], path[first + 1 : last + 1], strict=True)]
            hardest = max(float(forces.max()) for forces in replaced if forces is not None)
            if along.max() <= hardest + 1e-9:
                path = np.concatenate([path[: first + 1], path[last:]])
        return path

    def _along(self, start: Array, end: Array) -> Array | None:
        """Forces (S,) along a straight motion; None if one is not permitted or the arm meets a rigid body or itself."""
        self.checks += 1
        count = 1 + max(1, int(np.ceil(np.abs(end - start) @ levers(self._arm) / PathSettings().resolution)))
        postures = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
        forces = self.force(postures)
        if forces.max() > self._permitted or not self.rigid.motion_free(start, end):
            return None
        return forces

    def _takes(self, before: float, after: float, length: float) -> bool:
        """The transition test, with forces in shares of the permitted one."""
        settings = self._settings
        if after <= before:
            return True
        rise = (after - before) / self._permitted / max(min(length, settings.max_step), 1e-6)
        if self._random.uniform() < np.exp(-rise / self._temperature):
            self._temperature /= settings.temperature_factor
            self._refusals = 0
            return True
        self._refusals += 1
        if self._refusals > settings.patience:
            self._temperature *= settings.temperature_factor
            self._refusals = 0
        return False
