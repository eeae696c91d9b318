"""`contact-reach bench planner`: what a plan costs, where the time goes, and what other ways of planning cost.

Everything is measured in one run on problems from real closed-loop runs, and rollouts are measured alternately, so that
their ratios hold on a machine whose speed drifts. Wall-clock times hold for a machine of the planner's
own; processor times, which are beside them, do not count what other processes take.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from benchmarks import paper
from benchmarks.candidate_numbers import candidates_table, measure_candidates
from benchmarks.episode import EpisodeOptions
from benchmarks.grid import Cell, EpisodeTask, Setup, run_cell
from benchmarks.machine import machine
from benchmarks.output import Report, percentiles, say, write_report
from benchmarks.recorded_runs import RecordedRuns, RecordingPlanner, record_runs
from benchmarks.rollout_times import measure_rollouts, typical
from benchmarks.scaling import measure_scaling, plot_scaling, scaling_table
from benchmarks.solver_limit import limit_table, measure_limit
from benchmarks.workers import run_each
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import BRAX_PIPELINES, PlanningSettings
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.scene import SceneFile
from contact_reach_ros.world.spheres import sphere_capacity

TARGETS: dict[str, dict[str, float]] = {
    "free": {"solve_ms": 25.0, "step_ms": 5.0, "rollout_us_per_substep": 0.5},
    "ball": {"solve_ms": 35.0, "step_ms": 7.0, "rollout_us_per_substep": 0.6},
    "wall": {"solve_ms": 80.0, "step_ms": 15.0, "rollout_us_per_substep": 1.5},
}
"""What the planner should reach on one core with the paper's budget, at most."""

_CLOSED_LOOP_S, _LATENCY_S = 4.0, 0.1
"""Length of the runs in which torques and references are planned, and time of each plan there, s."""

PAPER_TORQUE_RATIO = paper.WALL_PLANNING_TIME[paper.JOINT_TORQUE] / paper.WALL_PLANNING_TIME[paper.METHOD]
"""Section V-B: planning joint torques against planning references, wall scene."""


@dataclass(frozen=True)
class PlannerBench:
    """How much is measured.

    Attributes
    ----------
    scenes
        Names or files.
    plans
        Least number of warm-started plans per scene.
    episodes
        Least number of closed-loop runs per scene that they come from.
    seed
        Of the first run and of the solver.
    brax
        Pipelines of Brax to compare with.
    repetitions
        Of each timing.
    cold_plans
        Recorded states to plan from scratch.
    settings
        The planner's; without a deadline, so that each plan ends by its own stop rule.
    arm
        Name of an arm, or path of its file.
    """

    scenes: tuple[str, ...]
    plans: int = 50
    episodes: int = 3
    seed: int = 0
    brax: tuple[str, ...] = ("generalized",)
    repetitions: int = 3
    cold_plans: int = 20
    settings: PlanningSettings = dataclasses.field(default_factory=lambda: PlanningSettings(deadline=0.0))
    arm: str = DEFAULT_ARM
    limit: bool = False
    """Whether to measure how near a solver step comes to what the core can do, and nothing else."""
    candidates: tuple[int, ...] = ()
    """Numbers of candidates of which to measure batches, and nothing else."""

    @classmethod
    def quick(cls, scenes: tuple[str, ...], seed: int) -> PlannerBench:
        """A run that shows that everything works, with numbers that mean little."""
        settings = PlanningSettings(
            deadline=0.0, population=16, elite=4, line_search_points=16, horizon=1, max_steps=3, substeps=2
        )
        return cls(scenes, 3, 1, seed, (), repetitions=1, cold_plans=1, settings=settings)


def bench_planner(bench: PlannerBench, file: Path | None, plot: Path | None) -> Report:
    """Measure, print a table and write JSON to `file`.

    With a file for it, also measure how the time of a step grows with k, H, nodes and cores, and draw that to `plot`.
    """
    settings = dataclasses.replace(bench.settings, seed=bench.seed)
    bench = dataclasses.replace(bench, settings=settings)
    report: Report = {}
    for name in bench.scenes:
        report[read_scene(name).name] = _bench_scene(bench, name)
    if plot is not None:
        say("growth with k, H, nodes and cores")
        report["scaling"] = measure_scaling(
            load_arm(bench.arm), settings, ImpedanceSettings(), load_budget().permitted_force
        )
        plot_scaling(report["scaling"], plot)
    report["machine"] = {**machine(), "seed": bench.seed, "arm": bench.arm}
    names = [read_scene(name).name for name in bench.scenes]
    if bench.limit:
        print(limit_table(report, names))
    else:
        print(candidates_table(report, names) if bench.candidates else _table(report, names))
    if plot is not None:
        print(f"\n{scaling_table(report['scaling'])}")
    write_report(report, file)
    return report


def _bench_scene(bench: PlannerBench, name: str) -> Report:
    scene_file, options, settings = read_scene(name), EpisodeOptions(budget=load_budget()), bench.settings
    gains, permitted_force = ImpedanceSettings(), options.budget.permitted_force
    planner = RecordingPlanner(load_arm(bench.arm), settings, gains, permitted_force, sphere_capacity(scene_file))
    planner.warm_up(say)
    if bench.limit:
        runs = record_runs(planner, scene_file, 1, bench.seed, options)
        solve = typical(runs)
        say(f"{scene_file.name}: a solver step and its limit")
        return {"limit": measure_limit(planner.solver, solve.problem, solve.state)}
    if bench.candidates:
        solve, pipelines = (
            typical(record_runs(planner, scene_file, 1, bench.seed, options)),
            ("closed_loop", *bench.brax),
        )
        numbers, rounds = bench.candidates, bench.repetitions
        return {
            "candidates": measure_candidates(planner.arm, solve.problem, settings, gains, pipelines, numbers, rounds)
        }
    say(f"{scene_file.name}: closed-loop runs")
    runs = record_runs(planner, scene_file, bench.plans, bench.seed, options, bench.episodes)
    report = _plan_times(runs)
    report["plan_error"] = _prediction_errors(runs)
    say(f"{scene_file.name}: cold starts")
    report["cold"] = _cold_starts(planner, runs, bench.cold_plans)
    report.update(measure_rollouts(runs, settings, gains, bench.brax, bench.repetitions))
    say(f"{scene_file.name}: joint torques")
    report.update(_torques(bench, scene_file))
    for compared in report["brax"].values():
        # Two batches per step, candidates and line search; the gradient would come on top.
        compared["solve_s_at_least"] = report["steps"]["p50"] * 2 * 1e-3 * compared["batch_ms"]
    return report


def _plan_times(runs: RecordedRuns) -> Report:
    """Times and steps of the warm-started plans."""
    warm = runs.warm
    steps = [recorded.plan.steps for recorded in warm]
    reasons = [recorded.plan.stop_reason for recorded in warm]
    return {
        "solve_ms": percentiles([1e3 * recorded.wall_s for recorded in warm]),
        "solve_cpu_ms": percentiles([1e3 * recorded.cpu_s for recorded in warm]),
        "step_ms": percentiles([1e3 * recorded.solve.seconds / recorded.plan.steps for recorded in warm]),
        "step_cpu_ms": percentiles([1e3 * recorded.solve.cpu_seconds / recorded.plan.steps for recorded in warm]),
        "steps": percentiles([float(count) for count in steps]),
        "stop_reasons": {reason: reasons.count(reason) for reason in sorted(set(reasons))},
        "rejected_candidates": sum(recorded.plan.rejected for recorded in warm),
        "plans": len(warm),
        "plans_with_contact": sum(recorded.touches for recorded in warm),
        "episodes": len(runs.scenes),
        "episodes_reached": runs.reached,
    }


def _prediction_errors(runs: RecordedRuns) -> Report:
    """Where the arm was when plans took effect against where the planner had expected it."""
    return {
        "position_mm": percentiles([1e3 * error.position for error in runs.errors]),
        "rotation_deg": percentiles([float(np.degrees(error.rotation)) for error in runs.errors]),
        "joint_deg": percentiles([float(np.degrees(error.joints)) for error in runs.errors]),
    }


def _cold_starts(planner: RecordingPlanner, runs: RecordedRuns, count: int) -> Report:
    """Plans for the same requests without warm start."""
    warm = runs.warm
    chosen = [warm[index] for index in np.linspace(0, len(warm) - 1, min(count, len(warm))).astype(int)]
    planner.recorded.clear()
    for recorded in chosen:
        planner.reset()
        planner.plan(recorded.request)
    return {
        "solve_ms": percentiles([1e3 * recorded.wall_s for recorded in planner.recorded]),
        "steps": percentiles([float(recorded.plan.steps) for recorded in planner.recorded]),
        "warm_steps": percentiles([float(recorded.plan.steps) for recorded in chosen]),
        "plans": len(chosen),
    }


def _torques(bench: PlannerBench, scene: SceneFile) -> Report:
    """Planning joint torques against planning references, each in a closed loop of its own as for Table I."""
    setup = Setup(arm=bench.arm, planning=bench.settings, budget=load_budget(), timeout=_CLOSED_LOOP_S)
    tasks = [
        EpisodeTask(Cell(scene.name, "hold", method, bench.seed), scene, _LATENCY_S, setup)
        for method in (paper.METHOD, paper.JOINT_TORQUE)
    ]
    # With one thread for linear algebra, as workers have: several, spinning, take ten times as long.
    timing = {record["method"]: record["timing"] for record in run_each(run_cell, tasks, 1)}
    references, torques = timing[paper.METHOD], timing[paper.JOINT_TORQUE]
    return {
        "torque_planning_ratio": torques["plan_s"] / references["plan_s"],
        "torque_planning": {"references": references, "torques": torques},
    }


def _table(report: Report, scenes: Sequence[str]) -> str:
    """One column for each scene; the numbers of the targets have these beside them."""
    lines = ["", f"{'':34}" + "".join(f"{name:>28}" for name in scenes)]
    for label, key, show in _ROWS:
        line = f"{label:34}"
        for name in scenes:
            target = TARGETS.get(name, {}).get(key)
            shown = show(report[name]) + (f"  [<= {target:g}]" if target is not None else "")
            line += f"{shown:>28}"
        lines.append(line)
    return "\n".join(lines)


def _brax_batch(pipeline: str, report: Report) -> str:
    measured = report["brax"].get(pipeline)
    return "-" if measured is None else "{batch_ms:.0f} ({timestep_ms:.2g})".format(**measured)


_ROWS: list[tuple[str, str, Callable[[Report], str]]] = [
    ("solve, ms p50 (p95, max)", "solve_ms", lambda r: "{p50:.1f} ({p95:.1f}, {max:.1f})".format(**r["solve_ms"])),
    ("one solver step, ms p50", "step_ms", lambda r: f"{r['step_ms']['p50']:.2f}"),
    ("candidate and substep, us", "rollout_us_per_substep", lambda r: f"{r['rollout_us_per_substep']:.2f}"),
    (
        "speed-up over Brax generalized",
        "",
        lambda r: f"{r['speedup_vs_generalized']:.0f}" if "speedup_vs_generalized" in r else "-",
    ),
    (
        "the same without waiting: solve, ms",
        "",
        lambda r: "{p50:.1f} ({p95:.1f}, {max:.1f})".format(**r["solve_cpu_ms"]),
    ),
    ("  one solver step, ms", "", lambda r: f"{r['step_cpu_ms']['p50']:.2f}"),
    ("  candidate and substep, us", "", lambda r: f"{r['rollout_cpu_us_per_substep']:.2f}"),
    ("steps p50, cold", "", lambda r: f"{r['steps']['p50']:.0f}, {r['cold']['steps']['p50']:.0f}"),
    ("cold solve, ms p50", "", lambda r: f"{r['cold']['solve_ms']['p50']:.1f}"),
    (
        "prediction error, mm p50 (p95)",
        "",
        lambda r: "{p50:.2f} ({p95:.2f})".format(**r["plan_error"]["position_mm"]),
    ),
    (
        "prediction error, deg p50 (p95)",
        "",
        lambda r: "{p50:.2f} ({p95:.2f})".format(**r["plan_error"]["rotation_deg"]),
    ),
    (
        f"torque planning, ratio [paper {PAPER_TORQUE_RATIO:.2f}]",
        "",
        lambda r: f"{r['torque_planning_ratio']:.2f}",
    ),
    ("rollout batch, ms", "", lambda r: f"{r['rollout_batch_ms']:.2f}"),
    ("MuJoCo, no controller, 2 threads", "", lambda r: f"{r['mujoco_two_threads']['batch_ms']:.0f}"),
    *((f"Brax {name}, ms (dt ms)", "", functools.partial(_brax_batch, name)) for name in BRAX_PIPELINES),
]
"""Label, key of `TARGETS` if it has one, and what is shown of a scene's report."""
