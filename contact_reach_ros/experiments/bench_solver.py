"""`contact-reach bench solver`: Algorithm 1 against plain CMA-ES and against many gradient steps (Section V-C)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.stats

from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.experiments.episode import EpisodeOptions
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.output import write_report
from contact_reach_ros.experiments.recorded_runs import RecordedPlan, RecordingPlanner, record_runs
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.action_space import ReferenceSpace, scaled_cost
from contact_reach_ros.planning.problem import Problem
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver import SOLVERS, make_solver
from contact_reach_ros.planning.solver.solver import Solver
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.spheres import sphere_capacity

PAPER = {"hybrid": 0.34, "cma": 0.22, "gradient": 0.40}
"""Cost decrease after ten steps in the paper's wall scene, whose cost has another scale than ours."""

STEPS = 10

STARTS = 3
"""How many starts the multi-start takes the best of: standing still and random motions."""


def bench_solver(
    scene: str = "wall", seeds: int = 20, file: Path | None = None, settings: PlanningSettings | None = None
) -> dict[str, Any]:
    """Run every method from the same states; print a table and write JSON to `file`.

    The states are spread over real closed-loop runs, half of them with contact where there is that much. From each, all
    methods start at standing still, with a fresh distribution and the same random numbers.

    Parameters
    ----------
    scene
        Name or file.
    seeds
        Number of states, each with random numbers of its own; at least 2.
    settings
        Of the planner; the paper's budget by default.

    Raises
    ------
    InputError
        If there are too few seeds for a confidence interval.
    """
    if seeds < 2:
        raise InputError(f"seeds = {seeds}: expected at least 2, for a confidence interval")
    settings = dataclasses.replace(settings or PlanningSettings(), deadline=0.0)
    scene_file, options = read_scene(scene), EpisodeOptions(budget=load_budget())
    gains, permitted_force = ImpedanceSettings(), options.budget.permitted_force
    arm = load_arm()
    planner = RecordingPlanner(arm, settings, gains, permitted_force, sphere_capacity(scene_file))
    planner.warm_up(print)
    runs = record_runs(planner, scene_file, 4 * seeds, 0, options, episodes=3)
    states = spread_states(runs.warm, seeds)

    space = ReferenceSpace(arm, settings, gains)
    cost, size = scaled_cost(space), len(space.bounds)
    still, spread = np.zeros(size), np.full(size, settings.sigma)
    single_cost = jax.jit(cost)
    limited = dataclasses.replace(settings, max_steps=STEPS, stagnation_steps=STEPS)
    solvers = {method: make_solver(cost, size, dataclasses.replace(limited, solver=method)) for method in SOLVERS}
    for solver in solvers.values():
        solver.warm_up(states[0].solve.problem, solver.init(still, spread))
    curves: dict[str, list[np.ndarray]] = {method: [] for method in solvers}
    seconds: dict[str, list[float]] = {method: [] for method in solvers}
    for number, state in enumerate(states):
        problem = state.solve.problem
        start_cost = float(single_cost(problem, single(still[:, None]))[0])
        for method, solver in solvers.items():
            began = time.perf_counter()
            solution = solver.solve(problem, solver.init(still, spread), start_cost, number)
            seconds[method].append(time.perf_counter() - began)
            curves[method].append(start_cost - np.array(solution.costs))
    report: dict[str, Any] = {
        method: _summary([curve[-1] for curve in curves[method]], seconds[method], curves[method]) for method in solvers
    }
    report["multi_start"] = _compare_starts(solvers["hybrid"], single_cost, states, settings, size)
    report["scene"] = scene_file.name
    report["states"] = len(states)
    report["states_with_contact"] = sum(state.touches for state in states)
    report["machine"] = machine()
    print(_table(report))
    write_report(report, file)
    return report


def _compare_starts(
    solver: Solver[Problem],
    single_cost: Callable[..., jax.Array],
    states: Sequence[RecordedPlan],
    settings: PlanningSettings,
    size: int,
) -> dict[str, Any]:
    """What more starts bring: the best of the first ones, and the time that they take together."""
    random = np.random.default_rng(settings.seed)
    spread = np.full(size, settings.sigma)
    decreases, seconds = np.zeros((len(states), STARTS)), np.zeros((len(states), STARTS))
    for number, state in enumerate(states):
        problem = state.solve.problem
        still_cost = float(single_cost(problem, single(np.zeros((size, 1))))[0])
        for index in range(STARTS):
            mean = random.uniform(-1.0, 1.0, size) if index else np.zeros(size)
            cost = float(single_cost(problem, single(mean[:, None]))[0])
            began = time.perf_counter()
            solution = solver.solve(problem, solver.init(mean, spread), cost, number)
            seconds[number, index] = time.perf_counter() - began
            decreases[number, index] = still_cost - solution.cost
    best = np.maximum.accumulate(decreases, axis=1)
    return {
        str(count + 1): {
            **_interval(best[:, count]),
            "ms": 1e3 * float(np.median(seconds[:, : count + 1].sum(axis=1))),
        }
        for count in range(STARTS)
    }


def spread_states(plans: Sequence[RecordedPlan], count: int) -> list[RecordedPlan]:
    """`count` plans, half of them with contact if there are that many, evenly over the runs."""
    touching = [plan for plan in plans if plan.touches]
    others = [plan for plan in plans if not plan.touches]
    with_contact = min(len(touching), max(count // 2, count - len(others)))
    return _evenly(touching, with_contact) + _evenly(others, count - with_contact)


def _evenly(plans: Sequence[RecordedPlan], count: int) -> list[RecordedPlan]:
    return [plans[index] for index in np.linspace(0, len(plans) - 1, count).astype(int)] if count else []


def _summary(decreases: Sequence[float], seconds: Sequence[float], curves: Sequence[np.ndarray]) -> dict[str, Any]:
    return {
        **_interval(decreases),
        "ms": 1e3 * float(np.median(seconds)),
        "decrease_by_step": [float(value) for value in np.mean(curves, axis=0)],
    }


def _interval(decreases: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """Mean and its 95 % confidence interval."""
    mean = float(np.mean(decreases))
    half = float(scipy.stats.t.ppf(0.975, len(decreases) - 1) * scipy.stats.sem(decreases))
    return {"decrease": mean, "ci95": [mean - half, mean + half]}


def _table(report: dict[str, Any]) -> str:
    lines = [
        f"cost decrease after {STEPS} steps, scene {report['scene']}, {report['states']} states, "
        f"{report['states_with_contact']} with contact",
        f"{'':10}{'mean':>8}{'95 % confidence':>22}{'share of hybrid':>18}{'ms':>8}{'paper':>8}{'share':>8}",
    ]
    for method, paper in PAPER.items():
        entry = report[method]
        low, high = entry["ci95"]
        share = entry["decrease"] / report["hybrid"]["decrease"]
        lines.append(
            f"{method:10}{entry['decrease']:8.4f}{f'{low:.4f} to {high:.4f}':>22}{share:>18.2f}"
            f"{entry['ms']:8.1f}{paper:8.2f}{paper / PAPER['hybrid']:8.2f}"
        )
    lines.append("hybrid, best of several starts")
    for count, entry in report["multi_start"].items():
        low, high = entry["ci95"]
        share = entry["decrease"] / report["multi_start"]["1"]["decrease"]
        lines.append(
            f"{count:10}{entry['decrease']:8.4f}{f'{low:.4f} to {high:.4f}':>22}{share:>18.2f}{entry['ms']:8.1f}"
        )
    return "\n".join(lines)
