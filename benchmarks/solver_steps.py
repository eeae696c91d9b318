"""Algorithm 1 against plain CMA-ES and many gradient steps, after ten steps each (Section V-C).

Every solver starts from the same states at standing still, with a fresh distribution and the same random
numbers.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.baselines.solvers import SOLVERS
from benchmarks.output import Report, command_line, given, machine, run_command, table, write_report
from benchmarks.recorded_plans import RecordedPlan
from benchmarks.solver import make_cost_of, make_tireless, states_of
from benchmarks.statistics import estimate
from contact_reach_ros.arms import load_arm
from contact_reach_ros.planning.cost import ReferenceSpace
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import Number, Problem, term_weights
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.presets import preset

PAPER = {"hybrid": 0.34, "cma": 0.22, "gradient": 0.40}
"""Cost decrease after ten steps in the paper's wall scene, whose cost has another scale than ours."""

STEPS = 10

_BUDGET = ("horizon", "substeps", "population")

SHIPPED, LITERAL = PRESETS = ("shipped", "paper_linear")
"""The planner as it is, and the paper's cost, sampling and boundary penalty as printed, with the same budget."""


def bench_solver_steps(
    scenes: Sequence[str] = ("ball", "wall"),
    states: int = 40,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> Report:
    """Decrease of the cost after ten steps, for both presets and every solver; print a table and write JSON.

    Parameters are those of `bench_solver`.

    Raises
    ------
    InputError
        If there are too few states for a confidence interval.
    """
    settings = dataclasses.replace(settings or PlanningSettings(), deadline=0.0)
    report: Report = {}
    for scene, found in states_of(scenes, states, settings):
        report[scene] = {"states": len(found), "states_with_contact": sum(state.touches for state in found)}
        for name in PRESETS:
            report[scene][name] = _decreases(name, settings, found)
    print(steps_table(report, list(report)))
    report["machine"] = machine()
    write_report(report, file)
    return report


def _decreases(preset_name: str, settings: PlanningSettings, states: Sequence[RecordedPlan]) -> Report:
    if preset_name == LITERAL:
        literal, budget = preset(LITERAL).planning, {key: getattr(settings, key) for key in _BUDGET}
        settings = dataclasses.replace(literal, **budget)
    gains, ramped = preset(preset_name).controller.impedance, preset_name == SHIPPED
    space = ReferenceSpace(load_arm(), settings, gains)
    cost, size = space.cost, len(space.bounds)
    still, spread = np.zeros(size), space.spread
    limited = dataclasses.replace(settings, max_steps=STEPS)
    problems = [_problem(state.problem, settings, ramped) for state in states]
    cost_of = make_cost_of(cost, size, settings)
    decreases: dict[str, list[float]] = {}
    seconds: dict[str, list[float]] = {}
    for name in SOLVERS:
        solver = make_tireless(name, cost, spread, limited)
        solver.solve(problems[0], still, math.inf, 0)  # compiles
        decreases[name], seconds[name] = [], []
        for number, problem in enumerate(problems):
            start_cost = cost_of(problem, still)
            began = time.perf_counter()
            found = solver.solve(problem, still, start_cost, number)
            seconds[name].append(time.perf_counter() - began)
            decreases[name].append(start_cost - found.cost)
    hybrid = np.array(decreases["hybrid"])
    return {
        name: {
            **estimate(values).json,
            "share": _share(np.array(values), hybrid),
            "ms": 1e3 * float(np.median(seconds[name])),
        }
        for name, values in decreases.items()
    }


def _problem(problem: Problem, settings: PlanningSettings, ramped: bool) -> Problem:
    """The problem with the weights of other settings, and without a reference before where references step."""
    weights: dict[str, Number] = {name: single(weight) for name, weight in term_weights(settings).items()}
    # Zero where the goal leaves the orientation free.
    weights["orientation"] = problem.weights["orientation"]
    # None of the states is on a detour.
    weights.pop("detour", None)
    return problem._replace(weights=weights, detour=None, before=problem.before if ramped else None)


def _share(values: np.ndarray, hybrid: np.ndarray) -> Report:
    """Ratio of the mean decreases, with an interval from a bootstrap over the states."""
    chosen = np.random.default_rng(0).integers(len(values), size=(10000, len(values)))
    low, high = np.quantile(values[chosen].mean(axis=1) / hybrid[chosen].mean(axis=1), (0.025, 0.975))
    return {"mean": float(values.mean() / hybrid.mean()), "ci95": [float(low), float(high)]}


def steps_table(report: Report, scenes: Sequence[str]) -> str:
    """A table in Markdown; the paper's own shares are in its last rows."""
    rows = []
    for scene in scenes:
        for configuration in PRESETS:
            for name in SOLVERS:
                entry = report[scene][configuration][name]
                low, high = entry["ci95"]
                decrease = f"{entry['mean']:.3f} ({low:.3f} to {high:.3f})"
                low, high = entry["share"]["ci95"]
                share = f"{entry['share']['mean']:.2f} ({low:.2f} to {high:.2f})"
                rows.append([scene, configuration, name, decrease, share, f"{entry['ms']:.0f}"])
    for name, value in PAPER.items():
        rows.append(["wall", "paper", name, f"{value:.2f}", f"{value / PAPER['hybrid']:.2f}", ""])
    return table(["scene", "preset", "solver", "decrease (95 %)", "share of the hybrid's", "ms"], rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: ball wall)")
    parser.add_argument("--states", type=int, help="to start from in each scene (default: 40)")
    bench_solver_steps(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
