"""Solvers at equal wall time (Section V-C): how far each gets from states of closed-loop runs, warm and cold.

Each solver takes as many steps as fit into the time. Its curve is the cost after each step, and a step's time the least
mean of all searches, so that what else runs on the machine shifts no solver against another.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

from benchmarks.baselines.solvers import SOLVERS
from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.recorded_plans import RecordedPlan, record_plans
from benchmarks.statistics import estimate
from contact_reach_ros.arm import Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import InputError
from contact_reach_ros.planning.cost import SIGMA, ReferenceSpace
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray
from contact_reach_ros.planning.terms import Problem
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.world.scene_file import read_scene

INSTANTS = (0.01, 0.03, 0.1)
"""Times of the table, s."""

POINTS = 51
"""Of each curve."""

_TIMED_STEPS = 10
"""From which the number of steps in a search is estimated."""


LABELS = {"hybrid": "hybrid, Algorithm 1", "cma": "plain CMA-ES", "gradient": "ten gradient steps each"}
"""Names of the solvers in tables and pictures."""


def make_tireless(name: str, cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> HybridSolver:
    """The solver of this name, whose searches end at the greatest number of steps only."""
    solver = SOLVERS[name](cost, spread, dataclasses.replace(settings, deadline=0.0))
    solver.stagnation_steps = 1_000_000
    return solver


def run_race(
    cost: CostFunction, size: int, settings: PlanningSettings, states: Sequence[RecordedPlan], seconds: float
) -> Report:
    """Search for `seconds` with every solver from every state, from standing still and from the plan before."""
    still, spread = np.zeros(size), np.full(size, SIGMA)
    solvers: dict[str, HybridSolver] = {}
    times: dict[str, list[float]] = {}
    for name in LABELS:
        solver = solvers[name] = make_tireless(name, cost, spread, settings)
        solver.max_steps = _TIMED_STEPS
        for _ in range(2):
            # The first one compiles.
            began = time.perf_counter()
            solver.solve(states[0].problem, still, math.inf, 0)
            step = (time.perf_counter() - began) / _TIMED_STEPS
        # Reserve, since steps take less time back to back.
        solver.max_steps = math.ceil(1.3 * seconds / step)
        times[name] = []
    cost_of = make_cost_of(cost, size, settings)
    costs: dict[str, dict[str, list[Array]]] = {start: {name: [] for name in solvers} for start in ("cold", "warm")}
    for number, state in enumerate(states):
        still_cost = cost_of(state.problem, still)
        for name, solver in solvers.items():
            for start, begin, cost_then in (
                ("cold", still, still_cost),
                ("warm", state.start, state.start_cost),
            ):
                began = time.perf_counter()
                found = solver.solve(state.problem, begin, cost_then, number)
                times[name].append((time.perf_counter() - began) / found.steps)
                costs[start][name].append(np.array(found.costs))
    steps = {name: min(each) for name, each in times.items()}
    return {
        "states": len(states),
        "states_with_contact": sum(state.touches for state in states),
        "seconds": seconds,
        "step_ms": {name: 1e3 * step for name, step in steps.items()},
        **_curves(costs, steps, seconds),
    }


def make_cost_of(cost: CostFunction, size: int, settings: PlanningSettings) -> Callable[[Problem, Array], float]:
    """The cost of single points (n,), by the program that evaluates candidates."""
    program = jax.jit(cost)

    def cost_of(problem: Problem, point: Array) -> float:
        points = single(np.broadcast_to(point[:, None], (size, settings.population)))
        return float(program(problem, points)[0])

    return cost_of


def _curves(costs: dict[str, dict[str, list[Array]]], steps: dict[str, float], seconds: float) -> Report:
    """Excess over the least cost that any search found from a state: at the table's instants, and as curves."""
    count = len(costs["cold"]["hybrid"])
    searches = [curves for by_name in costs.values() for curves in by_name.values()]
    least = [min(float(curves[index].min()) for curves in searches) for index in range(count)]
    report: Report = {}
    for start, by_name in costs.items():
        hybrid = excess(by_name["hybrid"], least, steps["hybrid"], INSTANTS)
        report[start] = {}
        for name, curves in by_name.items():
            at_instants = excess(curves, least, steps[name], INSTANTS)
            curve = excess(curves, least, steps[name], np.linspace(0.0, seconds, POINTS))
            report[start][name] = {
                "at": [estimate(values).json for values in at_instants.T],
                "over_hybrid": [estimate(values).json for values in (at_instants - hybrid).T],
                "curve": [estimate(values).json for values in curve.T],
            }
    return report


def excess(curves: Sequence[Array], least: Sequence[float], step: float, instants: Sequence[float] | Array) -> Array:
    """Excess cost (states, T) of each state's curve at the instants, s."""
    taken = np.floor(np.asarray(instants) / step + 1e-9).astype(int)
    return np.array([curve[np.minimum(taken, len(curve) - 1)] - low for curve, low in zip(curves, least, strict=True)])


def race_table(races: dict[str, Report]) -> str:
    """A table in Markdown: mean excess cost at the instants; and at the middle one less that of Algorithm 1."""
    middle = len(INSTANTS) // 2
    rows = []
    for scene, report in races.items():
        for start in ("cold", "warm"):
            for name, label in LABELS.items():
                entry = report[start][name]
                low, high = entry["over_hybrid"][middle]["ci95"]
                beside = "" if name == "hybrid" else f"{1e3 * low:+.1f} to {1e3 * high:+.1f}"
                at = [f"{1e3 * found['mean']:.1f}" for found in entry["at"]]
                rows.append([scene, start, label, f"{report['step_ms'][name]:.2f}", *at, beside])
    times = [f"after {1e3 * instant:.0f} ms" for instant in INSTANTS]
    beside = f"more than Algorithm 1 {times[middle]} (95 %)"
    return table(["scene", "start", "solver", "step, ms", *times, beside], rows)


def bench_solver(
    scenes: Sequence[str] = ("ball", "wall"),
    states: int = 40,
    seconds: float = 0.1,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> Report:
    """Run every solver from the same states; print a table and write JSON to `file`.

    Parameters
    ----------
    scenes
        Names or files.
    states
        In each scene, each with random numbers of its own; at least 2.
    seconds
        For each search.
    settings
        Of the planner; the paper's budget by default.

    Raises
    ------
    InputError
        If there are too few states for a confidence interval, or no time.
    """
    if not 0.001 <= seconds <= 60.0:
        raise InputError(f"seconds = {seconds:g}: expected 0.001 to 60")
    settings = dataclasses.replace(settings or PlanningSettings(), deadline=0.0)
    space = ReferenceSpace(load_arm(), settings, ImpedanceSettings())
    races = {
        name: run_race(space.cost, len(space.bounds), settings, found, seconds)
        for name, found in states_of(scenes, states, settings)
    }
    print(race_table(races))
    report: Report = {"bench": "solver", "machine": machine(), "scenes": races}
    write_report(report, file)
    return report


def states_of(
    scenes: Sequence[str], count: int, settings: PlanningSettings
) -> Iterator[tuple[str, list[RecordedPlan]]]:
    """Each scene's name, and plans of its closed-loop runs, half of them with contact where there are that many."""
    if count < 2:
        raise InputError(f"states = {count}: expected at least 2, for a confidence interval")
    for scene in scenes:
        file = read_scene(scene)
        found = record_plans(load_arm(), file, settings, count, episodes=3)
        say(f"{file.name}: {len(found)} states, {sum(state.touches for state in found)} with contact")
        yield file.name, found


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: ball wall)")
    parser.add_argument("--states", type=int, help="to start from in each scene (default: 40)")
    parser.add_argument("--seconds", type=float, help="for each search (default: 0.1)")
    bench_solver(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
