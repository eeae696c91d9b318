"""Time of a solver step against the number of candidates, on a CPU core or a GPU: `JAX_PLATFORMS=cpu` selects the CPU.

The solver starts from states of closed-loop runs, with a fresh distribution. A step's time is the least mean of all
searches of ten steps; the decrease of the cost in these is what more candidates gain.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.recorded_plans import RecordedPlan
from benchmarks.solver import make_cost_of, make_tireless, states_of
from benchmarks.solver_steps import STEPS
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.cost import ReferenceSpace
from contact_reach_ros.planning.settings import PlanningSettings

_SEARCHES = 3
"""From each state."""


def bench_population(
    scenes: Sequence[str] = ("free", "ball", "wall"),
    candidates: Sequence[int] = (200, 2000, 20000),
    states: int = 4,
    file: Path | None = None,
    settings: PlanningSettings | None = None,
) -> Report:
    """Time the steps with each number of candidates; print a table and write JSON to `file`.

    Other parameters are those of `bench_solver`.
    """
    settings = dataclasses.replace(settings or PlanningSettings(), deadline=0.0)
    rows = []
    for scene, found in states_of(scenes, states, settings):
        for population in candidates:
            row = _timed(dataclasses.replace(settings, population=population, max_steps=STEPS), found)
            rows.append({"scene": scene, "candidates": population, **row})
            say(f"{scene}, {population} candidates: ready in {row['ready_s']:.0f} s, {row['step_ms']:.2f} ms a step")
    # Not before: the first planner configures the backend.
    device = jax.devices()[0].device_kind
    header = ["scene", "candidates", "step, ms", "candidates a second", f"decrease in {STEPS} steps"]
    print(f"{device}\n\n{table(header, map(_cells, rows))}")
    report: Report = {"bench": "population", "device": device, "machine": machine(), "rows": rows}
    write_report(report, file)
    return report


def _timed(settings: PlanningSettings, states: Sequence[RecordedPlan]) -> Report:
    space = ReferenceSpace(load_arm(), settings, ImpedanceSettings())
    cost, size = space.cost, len(space.bounds)
    still = np.zeros(size)
    solver = make_tireless("hybrid", cost, space.spread, settings)
    began = time.perf_counter()
    solver.solve(states[0].problem, still, math.inf, 0)
    ready_s = time.perf_counter() - began
    cost_of = make_cost_of(cost, size, settings)
    times, decreases = [], []
    for number, state in enumerate(states):
        start_cost = cost_of(state.problem, still)
        for search in range(_SEARCHES):
            began = time.perf_counter()
            found = solver.solve(state.problem, still, start_cost, _SEARCHES * number + search)
            times.append((time.perf_counter() - began) / found.steps)
            decreases.append(start_cost - found.cost)
    return {"ready_s": ready_s, "step_ms": 1e3 * min(times), "decrease": float(np.mean(decreases))}


def _cells(row: Report) -> list[str]:
    rate = row["candidates"] / row["step_ms"] * 1e3
    return [row["scene"], str(row["candidates"]), f"{row['step_ms']:.2f}", f"{rate:,.0f}", f"{row['decrease']:.3f}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)")
    parser.add_argument("--candidates", type=int, nargs="+", help="numbers of candidates (default: 200 2000 20000)")
    parser.add_argument("--states", type=int, help="to start from in each scene (default: 4)")
    bench_population(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
