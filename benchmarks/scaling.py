"""How a solver step and its program grow with the problem, and how reading obstacles grows with their number.

Each row changes one thing of the shipped settings. The problem is that of the scene's start, CPU times are the least of
several, of one thread; two threads are compared by the clock. `python -m benchmarks.population` has more candidates, on
a GPU too.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.lanes.compiled import Compiled
from contact_reach_ros.planning.obstacles import ObstacleReader, check_motion, nearest_bodies
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import HybridSolver
from contact_reach_ros.planning.solver.solver import CostFunction, FloatArray, Solution
from contact_reach_ros.planning.terms import Problem
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Block
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions, sphere_capacity

VARIANTS: dict[str, Sequence[Any]] = {
    "population": (50, 200, 500, 1000, 2000),
    "horizon": (3, 6, 9, 12),
    "spheres": (0, 1, 12, 40),
    "arm": ("ur10", "iiwa14"),
    "backend": ("auto", "xla"),
}
"""What is changed, and to what; "spheres" are those that the program takes."""
SEEN = (1, 20, 500, 8000, 20000)
"""Numbers of spheres that are read, of which the program takes 12."""
_BOXES, _POSTURES = 20, 13
_STEPS, _REPEATS = 20, 5
_TURNS = 200


class TimedSolver(HybridSolver):
    """Solves each problem several times; a step's CPU time is the least mean, s.

    Attributes
    ----------
    problem
        The last one.
    """

    step_s = math.inf
    problem: Problem

    def __init__(self, cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> None:
        super().__init__(cost, spread, settings)
        self.cost, self.size, self.population = cost, len(spread), settings.population

    def solve(
        self, problem: Problem, start: FloatArray, start_cost: float, number: int, until: float = math.inf
    ) -> Solution:
        """Run Algorithm 1 several times, as `HybridSolver.solve`."""
        self.stagnation_steps, self.problem = self.max_steps + 1, problem
        for _ in range(_REPEATS):
            began = time.process_time()
            solution = super().solve(problem, start, start_cost, number)
            self.step_s = min(self.step_s, (time.process_time() - began) / solution.steps)
        return solution


def bench_scaling(scene: str = "ball", of: Sequence[str] = tuple(VARIANTS), file: Path | None = None) -> Report:
    """Time everything; print tables in Markdown and write JSON to `file`.

    Parameters
    ----------
    scene
        Name or file.
    of
        Which of `VARIANTS`.
    """
    rows = []
    for name in of:
        for value in VARIANTS[name]:
            rows.append({"changed": name, "to": value, **_step(scene, name, value)})
            say(f"{name} {value}: {rows[-1]['step_ms']:.2f} ms a step, ready in {rows[-1]['ready_s']:.0f} s")
    print(table(["changed", "to", "step, ms", "ready, s"], map(_cells, rows)) + "\n")
    read = _reading()
    print(table(["obstacles", "ms"], [[name, f"{value:.2f}"] for name, value in read.items()]) + "\n")
    threads = _threads(scene)
    print(table(["candidates", "1 thread, ms", "2 threads, ms", "ratio"], map(_thread_cells, threads)))
    report: Report = {"bench": "scaling", "scene": scene, "machine": machine(), "rows": rows, "reading_ms": read}
    report["threads"] = threads
    write_report(report, file)
    return report


def _step(scene_name: str, name: str, value: Any) -> Report:
    """CPU time of a solver step, ms, and until the first plan, s."""
    settings = PlanningSettings()
    if name in ("population", "horizon"):
        settings = dataclasses.replace(settings, **{name: value})
    began = time.process_time()
    arm = load_arm(value) if name == "arm" else load_arm()
    planner, request, solver = make_timed(scene_name, arm, settings, value if name == "spheres" else 1)
    with mock.patch.object(Compiled, "__call__", _as_it_is) if value == "xla" else nullcontext():
        planner.plan(request)
        ready_s = time.process_time() - began - _REPEATS * _STEPS * solver.step_s
        planner.plan(request)
    return {"step_ms": 1e3 * solver.step_s, "ready_s": ready_s}


def _as_it_is(function: Compiled, given: Any, candidates: jax.Array) -> Any:
    """For XLA to compile."""
    return function._function(given, candidates)


def _threads(scene_name: str) -> list[Report]:
    """Time, ms, of the cost of candidates in one thread, and of one half of them in each of two, in turns."""
    planner, request, solver = make_timed(scene_name, load_arm(), PlanningSettings(), 1)
    planner.plan(request)
    cost = functools.partial(jax.jit(Compiled(solver.cost)), solver.problem)
    rows = []
    with ThreadPoolExecutor(2) as pool:
        for count in VARIANTS["population"]:
            points = np.random.default_rng(0).uniform(-1.0, 1.0, (solver.size, count)).astype(np.float32)
            shares = [[points], np.split(points, 2, axis=1)]
            spent: list[list[float]] = [[], []]
            for _ in range(_TURNS):
                for share, times in zip(shares, spent, strict=True):
                    began = time.perf_counter()
                    list(pool.map(lambda part: cost(part).block_until_ready(), share))
                    times.append(1e3 * (time.perf_counter() - began))
            rows.append({"candidates": count, "ms": [min(times) for times in spent]})
    return rows


def make_timed(
    scene_name: str, arm: Arm, settings: PlanningSettings, capacity: int | None = None
) -> tuple[RecedingHorizonPlanner, Request, TimedSolver]:
    """A planner without deadline for the start of a scene, what to ask it for, and its solver.

    Parameters
    ----------
    scene_name
        Name or file.
    arm
        The arm.
    settings
        What the planner is made of; each search takes the same number of steps.
    capacity
        Number of spheres that the program takes; as many as the nodes choose for the scene by default.
    """
    scene = make_scene(read_scene(scene_name), arm, 0)
    found: list[TimedSolver] = []

    def make(cost: CostFunction, spread: FloatArray, settings: PlanningSettings) -> TimedSolver:
        found.append(TimedSolver(cost, spread, settings))
        return found[0]

    planner = RecedingHorizonPlanner(
        scene.arm,
        dataclasses.replace(settings, deadline=0.0, max_steps=_STEPS),
        ControllerSettings(),
        load_budget().permitted_force,
        sphere_capacity(scene) if capacity is None else capacity,
        solver=make,
    )
    spheres = obstacle_spheres(scene, rest_positions(scene))
    return planner, Request(scene.start, np.zeros(scene.arm.n), 0, 0, Target(scene.target), spheres), found[0]


def _reading() -> dict[str, float]:
    """Least times, ms, of reading spheres that nothing joins, and of looking for the nearest of many boxes."""
    arm, random = load_arm(), np.random.default_rng(0)
    q, times = np.array(arm.home), {}
    for count in SEEN:
        center, size = random.uniform(-1.0, 1.0, (count, 3)), np.ones(count)
        cloud = Spheres(center, center, 0.02 * size, 100.0 * size, 5.0 * size)
        times[f"{count} spheres"] = _least(functools.partial(_read, arm, q, cloud))
    boxes = tuple(
        Block(f"box {index}", center, (0.1, 0.2, 0.3))
        for index, center in enumerate(random.uniform((0.2, -1.0, -1.0), (2.2, 1.0, 1.0), (_BOXES, 3)))
    )
    way = q + np.linspace(0.0, 0.1, _POSTURES)[:, None] * np.ones(arm.n)
    times[f"the nearest of {_BOXES} boxes"] = _least(lambda: nearest_bodies(arm, q, boxes))
    times[f"{_BOXES} boxes beside a motion"] = _least(lambda: check_motion(arm, way, boxes))
    return times


def _read(arm: Arm, q: Array, spheres: Spheres) -> None:
    """For the first time: nothing is known of the spheres."""
    ObstacleReader(arm, 12).read(q, spheres)


def _least(run: Callable[[], object]) -> float:
    spent = []
    for _ in range(20):
        began = time.process_time()
        run()
        spent.append(time.process_time() - began)
    return 1e3 * min(spent)


def _cells(row: Report) -> list[str]:
    return [row["changed"], str(row["to"]), f"{row['step_ms']:.2f}", f"{row['ready_s']:.0f}"]


def _thread_cells(row: Report) -> list[str]:
    one, two = row["ms"]
    return [str(row["candidates"]), f"{one:.2f}", f"{two:.2f}", f"{one / two:.2f}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scene", metavar="SCENE", help="name or YAML file (default: ball)")
    parser.add_argument("--of", nargs="+", choices=tuple(VARIANTS), help="what is changed (default: all)")
    bench_scaling(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
