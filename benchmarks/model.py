"""`contact-reach bench model --against`: the plans of closed-loop runs, rolled out by Brax and by MuJoCo beside ours.

Every model starts from the state for which the plan was made, with the references in force then, and follows the plan's
actions. MuJoCo's is the simulated robot at 1 ms under the controller's own law, without joint friction. The plans are
made without a weight on permitted contact, so that the arm leans on what it may touch.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.episode import EpisodeOptions
from benchmarks.model_cases import simulate_from
from benchmarks.output import percentiles, say, table, write_report
from benchmarks.recorded_runs import RecordedPlan, RecordingPlanner, record_runs, spread_states
from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.control.references import Reference
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.action_space import ReferenceSpace
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import sphere_capacity

OURS, MUJOCO = "closed_loop", "MuJoCo"


class Outcome(NamedTuple):
    """Motion that a model predicts for a plan, at the ends of its knots."""

    positions: Array
    """(H, 3) tip, m."""
    joints: Array
    """(H, n), rad."""
    force: float
    """Largest force on a link within the horizon, N."""


def bench_referee(
    against: Sequence[str],
    scenes: Sequence[str] = ("free", "ball", "wall"),
    plans: int = 12,
    seed: int = 0,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> dict[str, Any]:
    """Roll out, print a table in Markdown and write JSON to `file`.

    Parameters
    ----------
    against
        Pipelines of Brax.
    scenes
        Names or files.
    plans
        Number of plans per scene, half of them with contact where there are that many.
    seed
        Of the runs that the plans come from.
    settings
        Of the planner; by default the paper's budget.
    """
    settings = dataclasses.replace(settings or PlanningSettings(), contact_weight=0.0, deadline=0.0, seed=seed)
    report: dict[str, Any] = {"plans": plans, "seed": seed, "scenes": {}}
    for name in scenes:
        recorded = _plans(name, plans, seed, settings)
        outcomes = {MUJOCO: [_simulated(scene, plan) for scene, plan in recorded]}
        for pipeline in (OURS, *against):
            began = time.perf_counter()
            outcomes[pipeline] = _predicted(pipeline, [plan for _, plan in recorded], settings)
            say(f"{name}: {pipeline} took {time.perf_counter() - began:.0f} s, compilation included")
        report["scenes"][name] = {
            "largest_force_n": percentiles([outcome.force for outcome in outcomes[MUJOCO]]),
            "rows": [_compared(outcomes, one, MUJOCO) for one in (OURS, *against)]
            + [_compared(outcomes, OURS, one) for one in against],
        }
    print(_table(report))
    write_report(report, file)
    return report


def _plans(name: str, count: int, seed: int, settings: PlanningSettings) -> list[tuple[Scene, RecordedPlan]]:
    """Plans of a closed-loop run, and the scene as it was at their start."""
    scene_file, options = read_scene(name), EpisodeOptions(budget=load_budget())
    planner = RecordingPlanner(
        load_arm(), settings, ImpedanceSettings(), options.budget.permitted_force, sphere_capacity(scene_file)
    )
    planner.warm_up(say)
    runs = record_runs(planner, scene_file, count, seed, options)
    return [(runs.scenes[0], plan) for plan in spread_states(runs.warm, count)]


def _predicted(pipeline: str, plans: Sequence[RecordedPlan], settings: PlanningSettings) -> list[Outcome]:
    space = ReferenceSpace(load_arm(), dataclasses.replace(settings, pipeline=pipeline), ImpedanceSettings())
    roll_out = jax.jit(lambda problem, points: space.objective.roll_out(problem, space.actions(points, problem)))
    outcomes = []
    for plan in plans:
        rollout = jax.device_get(roll_out(plan.solve.problem, plan.solve.solution.best[:, None]))
        force = float(rollout.link_force.max())
        outcomes.append(Outcome(rollout.pose.position[1:, :, 0], rollout.q[1:, :, 0], force))
    return outcomes


def _simulated(scene: Scene, plan: RecordedPlan) -> Outcome:
    problem = jax.device_get(plan.solve.problem)
    space = ReferenceSpace(scene.arm, PlanningSettings(horizon=len(plan.plan.positions)), ImpedanceSettings())
    point = single(plan.solve.solution.best[:, None])
    actions = np.asarray(space.actions(point, problem), np.float64)[..., 0]
    spheres = plan.request.spheres.center
    if problem.obstacles is not None and len(spheres) == problem.obstacles.center.shape[1]:
        # As predicted for the start of the plan; of a wall the planner knows only a part there.
        spheres = np.asarray(problem.obstacles.center[..., 0].T, np.float64)
    before = None
    if problem.before is not None:
        before = Reference(*(np.asarray(part, np.float64)[..., 0] for part in problem.before))
    start = problem.q[:, 0].astype(float)
    motion = simulate_from(
        dataclasses.replace(scene, start=start), problem.v[:, 0].astype(float), actions, before, spheres
    )
    return Outcome(motion.positions, motion.joints, float(motion.forces.max()))


def _compared(outcomes: dict[str, list[Outcome]], one: str, other: str) -> dict[str, Any]:
    """Largest differences of each plan between two models."""
    pairs = list(zip(outcomes[one], outcomes[other], strict=True))
    return {
        "model": one,
        "against": other,
        "tip_mm": percentiles([1e3 * np.linalg.norm(a.positions - b.positions, axis=1).max() for a, b in pairs]),
        "joints_deg": percentiles([np.degrees(np.abs(a.joints - b.joints).max()) for a, b in pairs]),
        "force_n": percentiles([abs(a.force - b.force) for a, b in pairs]),
    }


def _table(report: dict[str, Any]) -> str:
    header = ["scene (force, N p50, max)", "model", "against", "tip, mm p50", "max", "joints, deg p50", "max"]
    rows = []
    for name, scene in report["scenes"].items():
        force = scene["largest_force_n"]
        for row in scene["rows"]:
            values = [row[key][size] for key in ("tip_mm", "joints_deg", "force_n") for size in ("p50", "max")]
            label = f"{name} ({force['p50']:.1f}, {force['max']:.1f})"
            rows.append([label, row["model"], row["against"], *(f"{value:.2f}" for value in values)])
    return table([*header, "force, N p50", "max"], rows)
