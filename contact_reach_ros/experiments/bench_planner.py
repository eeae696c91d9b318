"""`contact-reach bench planner`: what a plan costs, where the time goes, and what other ways of planning cost.

Everything is measured in one run on problems from real closed-loop runs, and what is compared is measured alternately,
so that ratios hold on a machine whose speed drifts. Wall-clock times say what the planner is like on a machine of its
own; processor times, which are beside them, do not count what other processes take.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import mujoco
import mujoco.rollout
import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.recorded_runs import RecordedRuns, RecordingPlanner, Solve, record_runs
from contact_reach_ros.experiments.scaling import measure_scaling, plot_scaling
from contact_reach_ros.experiments.torque_planning import compare_with_torques
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.objectives import action_bounds, make_objective, scaled_cost
from contact_reach_ros.planning.settings import BRAX_PIPELINES, PlanningSettings
from contact_reach_ros.plant.plant import TICK, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import sphere_capacity

Report = dict[str, Any]

_MANY_SPHERES, _FEW_CANDIDATES = 4, 8
"""With more spheres than this, Brax would take minutes for a whole batch: it gets this many candidates instead."""

TARGETS: dict[str, dict[str, float]] = {
    "free": {"solve_ms": 25.0, "step_ms": 5.0, "rollout_us_per_substep": 0.5, "speedup_vs_generalized": 150.0},
    "ball": {"solve_ms": 35.0, "step_ms": 7.0, "rollout_us_per_substep": 0.6, "speedup_vs_generalized": 400.0},
    "wall": {"solve_ms": 80.0, "step_ms": 15.0, "rollout_us_per_substep": 1.5},
}
"""What the planner should reach on one core with the paper's budget: at least for the speed-up, else at most."""

PAPER_TORQUE_RATIO = 1.34 / 0.47
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
        Which of Brax's pipelines to compare with.
    repetitions
        Of each timing.
    torque_knots
        Knots carried out from each start when planning torques; 0 for none.
    cold_plans
        Recorded states to plan from scratch.
    settings
        The planner's; without a deadline, so that each plan ends by its own stop rule.
    """

    scenes: tuple[str, ...]
    plans: int = 50
    episodes: int = 3
    seed: int = 0
    brax: tuple[str, ...] = BRAX_PIPELINES
    repetitions: int = 3
    torque_knots: int = 8
    cold_plans: int = 20
    settings: PlanningSettings = dataclasses.field(default_factory=lambda: PlanningSettings(deadline=0.0))

    @classmethod
    def quick(cls, scenes: tuple[str, ...], seed: int) -> PlannerBench:
        """A run that shows that everything works, with numbers that mean little."""
        settings = PlanningSettings(
            deadline=0.0, population=16, elite=4, line_search_points=16, horizon=1, max_steps=3, substeps=2
        )
        return cls(
            scenes,
            3,
            1,
            seed,
            (),
            repetitions=1,
            torque_knots=1,
            cold_plans=1,
            settings=settings,
        )


def bench_planner(bench: PlannerBench, file: Path | None, plot: Path | None) -> Report:
    """Measure, print a table and write JSON to `file`.

    With a file for it, also measure how the time of a step grows with k, H and nodes, and draw that to `plot`.
    """
    settings = dataclasses.replace(bench.settings, seed=bench.seed)
    bench = dataclasses.replace(bench, settings=settings)
    report: Report = {}
    for name in bench.scenes:
        report[read_scene(name).name] = _bench_scene(bench, name)
    if plot is not None:
        _say("growth with k, H and nodes")
        report["scaling"] = measure_scaling(settings, ImpedanceSettings(), load_budget().permitted_force)
        plot_scaling(report["scaling"], plot)
    report["machine"] = {**machine(), "seed": bench.seed}
    print(_table(report, [read_scene(name).name for name in bench.scenes]))
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _bench_scene(bench: PlannerBench, name: str) -> Report:
    scene_file, options, settings = read_scene(name), EpisodeOptions(budget=load_budget()), bench.settings
    gains, permitted_force = ImpedanceSettings(), options.budget.permitted_force
    planner = RecordingPlanner(settings, gains, permitted_force, sphere_capacity(scene_file))
    planner.warm_up(_say)
    _say(f"{scene_file.name}: closed-loop runs")
    runs = record_runs(planner, scene_file, bench.plans, bench.seed, options, bench.episodes)
    report = _plan_times(runs)
    report["plan_error"] = _prediction_errors(runs)
    _say(f"{scene_file.name}: cold starts")
    report["cold"] = _cold_starts(planner, runs, bench.cold_plans)
    report.update(_rollouts(bench, gains, runs))
    if bench.torque_knots:
        _say(f"{scene_file.name}: joint torques")
        report.update(_torques(bench, gains, runs))
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
        "solve_ms": _percentiles([1e3 * recorded.wall_s for recorded in warm]),
        "solve_cpu_ms": _percentiles([1e3 * recorded.cpu_s for recorded in warm]),
        "step_ms": _percentiles([1e3 * recorded.solve.seconds / recorded.plan.steps for recorded in warm]),
        "step_cpu_ms": _percentiles([1e3 * recorded.solve.cpu_seconds / recorded.plan.steps for recorded in warm]),
        "steps": _percentiles([float(count) for count in steps]),
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
        "position_mm": _percentiles([1e3 * error.position for error in runs.errors]),
        "rotation_deg": _percentiles([float(np.degrees(error.rotation)) for error in runs.errors]),
        "joint_deg": _percentiles([float(np.degrees(error.joints)) for error in runs.errors]),
    }


def _cold_starts(planner: RecordingPlanner, runs: RecordedRuns, count: int) -> Report:
    """The same requests, answered from scratch."""
    warm = runs.warm
    chosen = [warm[index] for index in np.linspace(0, len(warm) - 1, min(count, len(warm))).astype(int)]
    planner.recorded.clear()
    for recorded in chosen:
        request = recorded.request
        planner.reset()
        planner.plan(request.q, request.v, request.state_ns, request.effect_ns, request.goal, request.spheres)
    return {
        "solve_ms": _percentiles([1e3 * recorded.wall_s for recorded in planner.recorded]),
        "steps": _percentiles([float(recorded.plan.steps) for recorded in planner.recorded]),
        "warm_steps": _percentiles([float(recorded.plan.steps) for recorded in chosen]),
        "plans": len(chosen),
    }


def _rollouts(bench: PlannerBench, gains: ImpedanceSettings, runs: RecordedRuns) -> Report:
    """Time of one batch of candidates in this package's transfer model, in Brax's pipelines and in plain MuJoCo."""
    settings = bench.settings
    problem = _typical(runs).problem
    bounds = action_bounds(settings)
    obstacles = problem.obstacles
    spheres = 0 if obstacles is None else obstacles.radius.shape[0]
    shape = (len(bounds), settings.population)
    every = np.random.default_rng(bench.seed).uniform(-1.0, 1.0, shape).astype(np.float32)
    programs: dict[str, Callable[[], object]] = {}
    steps: dict[str, int] = {}
    lanes: dict[str, int] = {"mujoco": settings.population}
    for name in ("closed_loop", *bench.brax):
        objective = make_objective(dataclasses.replace(settings, pipeline=name), gains)
        cost = jax.jit(scaled_cost(objective, bounds))
        steps[name] = objective.integration_steps
        lanes[name] = settings.population
        if name != "closed_loop" and spheres > _MANY_SPHERES:
            lanes[name] = min(settings.population, _FEW_CANDIDATES)
        points = every[:, : lanes[name]]
        _say(f"compiling a batch of {lanes[name]} candidates, {name}")
        began = time.perf_counter()
        jax.block_until_ready(cost(problem, points))
        _say(f"  {time.perf_counter() - began:.1f} s")
        programs[name] = functools.partial(_run, cost, problem, points)
    duration = settings.horizon * settings.knot_duration
    programs["mujoco"] = _mujoco_batch(runs.scenes[0], settings.population, duration, threads=2)
    times, cpu_times = _alternately(programs, bench.repetitions, {"closed_loop": 20, "mujoco": 3})
    # Brax's time is in proportion to the number of candidates, whatever that is.
    times = {name: value * settings.population / lanes[name] for name, value in times.items()}
    own = times["closed_loop"]
    candidate_steps = settings.population * steps["closed_loop"]

    def compared(name: str, count: int) -> Report:
        return {
            "batch_ms": 1e3 * times[name],
            "timestep_ms": 1e3 * duration / count,
            "us_per_candidate_and_step": 1e6 * times[name] / (settings.population * count),
            "s_per_simulated_s": times[name] / (settings.population * duration),
            "ratio_to_closed_loop": times[name] / own,
            "candidates_measured": lanes[name],
        }

    report: Report = {
        "rollout_us_per_substep": 1e6 * own / candidate_steps,
        "rollout_cpu_us_per_substep": 1e6 * cpu_times["closed_loop"] / candidate_steps,
        "rollout_batch_ms": 1e3 * own,
        "rollout_s_per_simulated_s": own / (settings.population * duration),
        "brax": {name: compared(name, steps[name]) for name in bench.brax},
        "mujoco_two_threads": compared("mujoco", round(duration / TICK)),
    }
    if "generalized" in bench.brax:
        report["speedup_vs_generalized"] = times["generalized"] / own
    return report


def _run(program: Callable[..., jax.Array], *arguments: object) -> None:
    jax.block_until_ready(program(*arguments))


def _mujoco_batch(scene: Scene, candidates: int, duration: float, threads: int) -> Callable[[], object]:
    """A rollout of the plant's own MuJoCo model, held against gravity by constant torques, without any controller."""
    plant = Plant(scene, SensorSettings(), JointSettings())
    model, data = plant.model, plant.data
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    count = round(duration / TICK)
    control = np.tile(data.qfrc_bias[: iiwa14.N_JOINTS], (candidates, count, 1))
    states = np.tile(state, (candidates, 1))
    workers = [mujoco.MjData(model) for _ in range(threads)]
    return lambda: mujoco.rollout.rollout(model, workers, states, control)


def _torques(bench: PlannerBench, gains: ImpedanceSettings, runs: RecordedRuns) -> Report:
    """Planning joint torques against planning references."""
    starts = [recorded.solve.problem for recorded in runs.plans if recorded.first]
    records = compare_with_torques(bench.settings, gains, starts, bench.torque_knots)
    references, torques = records["references"], records["torques"]

    def shown(record: Any) -> Report:
        return {
            "variables": record.variables,
            "mean_ms": 1e3 * float(np.mean(record.seconds)),
            "mean_cpu_ms": 1e3 * float(np.mean(record.cpu_seconds)),
            "solve_ms": _percentiles([1e3 * seconds for seconds in record.seconds]),
            "steps": _percentiles([float(count) for count in record.steps]),
            "approach_m": float(np.mean(record.approach)),
        }

    return {
        "torque_planning_ratio": float(np.mean(torques.cpu_seconds) / np.mean(references.cpu_seconds)),
        "torque_planning": {"references": shown(references), "torques": shown(torques)},
    }


def _typical(runs: RecordedRuns) -> Solve:
    """A recorded solve with contact if there is one, from the middle of the runs."""
    warm = runs.warm
    touching = [recorded for recorded in warm if recorded.touches]
    chosen = touching or warm
    return chosen[len(chosen) // 2].solve


def _alternately(
    programs: dict[str, Callable[[], object]], rounds: int, repeated: dict[str, int]
) -> tuple[dict[str, float], dict[str, float]]:
    """Median wall-clock and processor time of each program in s, measured in turns.

    `repeated` says how often a program runs in each round.
    """
    wall_times: dict[str, list[float]] = {name: [] for name in programs}
    cpu_times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            for _ in range(repeated.get(name, 1)):
                cpu, wall = time.process_time(), time.perf_counter()
                program()
                wall_times[name].append(time.perf_counter() - wall)
                cpu_times[name].append(time.process_time() - cpu)
    medians = ({name: float(np.median(values)) for name, values in kind.items()} for kind in (wall_times, cpu_times))
    wall_medians, cpu_medians = medians
    return wall_medians, cpu_medians


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    p50, p95, largest = np.percentile(values, [50, 95, 100])
    return {"p50": float(p50), "p95": float(p95), "max": float(largest)}


def _say(line: str) -> None:
    print(line, flush=True)


def _table(report: Report, scenes: Sequence[str]) -> str:
    """The numbers of the targets beside them, and the comparisons."""
    rows = [
        ("solve, ms p50 (p95, max)", "solve_ms", lambda r: "{p50:.1f} ({p95:.1f}, {max:.1f})".format(**r["solve_ms"])),
        ("one solver step, ms p50", "step_ms", lambda r: f"{r['step_ms']['p50']:.2f}"),
        (
            "candidate and substep, us",
            "rollout_us_per_substep",
            lambda r: f"{r['rollout_us_per_substep']:.2f}",
        ),
        (
            "speed-up over Brax generalized",
            "speedup_vs_generalized",
            lambda r: f"{r['speedup_vs_generalized']:.0f}" if "speedup_vs_generalized" in r else "-",
        ),
    ]
    lines = ["", f"{'':34}" + "".join(f"{name:>28}" for name in scenes)]
    for label, key, show in rows:
        line = f"{label:34}"
        for name in scenes:
            target = TARGETS.get(name, {}).get(key)
            sign = ">=" if key.startswith("speedup") else "<="
            shown = show(report[name]) + (f"  [{sign} {target:g}]" if target is not None else "")
            line += f"{shown:>28}"
        lines.append(line)
    others: list[tuple[str, Callable[[Report], str]]] = [
        (
            "the same without waiting: solve, ms",
            lambda r: "{p50:.1f} ({p95:.1f}, {max:.1f})".format(**r["solve_cpu_ms"]),
        ),
        ("  one solver step, ms", lambda r: f"{r['step_cpu_ms']['p50']:.2f}"),
        ("  candidate and substep, us", lambda r: f"{r['rollout_cpu_us_per_substep']:.2f}"),
        ("steps p50, cold", lambda r: f"{r['steps']['p50']:.0f}, {r['cold']['steps']['p50']:.0f}"),
        ("cold solve, ms p50", lambda r: f"{r['cold']['solve_ms']['p50']:.1f}"),
        (
            "prediction error, mm p50 (p95)",
            lambda r: "{p50:.2f} ({p95:.2f})".format(**r["plan_error"]["position_mm"]),
        ),
        (
            "prediction error, deg p50 (p95)",
            lambda r: "{p50:.2f} ({p95:.2f})".format(**r["plan_error"]["rotation_deg"]),
        ),
        (
            f"torque planning, ratio [paper {PAPER_TORQUE_RATIO:.2f}]",
            lambda r: f"{r['torque_planning_ratio']:.2f}" if "torque_planning_ratio" in r else "-",
        ),
        ("rollout batch, ms", lambda r: f"{r['rollout_batch_ms']:.2f}"),
        ("MuJoCo, no controller, 2 threads", lambda r: f"{r['mujoco_two_threads']['batch_ms']:.0f}"),
    ]
    others += [(f"Brax {name}, ms (dt ms)", functools.partial(_brax_batch, name)) for name in BRAX_PIPELINES]
    for label, show in others:
        lines.append(f"{label:34}" + "".join(f"{show(report[name]):>28}" for name in scenes))
    return "\n".join(lines)


def _brax_batch(pipeline: str, report: Report) -> str:
    measured = report["brax"].get(pipeline)
    return "-" if measured is None else "{batch_ms:.0f} ({timestep_ms:.2g})".format(**measured)
