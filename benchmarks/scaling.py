"""How the time of a solver step grows with candidates, horizon, obstacle nodes and cores."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.drawing.palette import BLUE, GREY
from contact_reach_ros.experiments.output import table
from contact_reach_ros.experiments.recorded_runs import RecordingPlanner
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

POPULATIONS = (50, 200, 400, 1000)
HORIZONS = (1, 3, 5)
NODES = (0, 1, 4, 12, 24)

_STEPS = 10
_ROUNDS = 5

Curve = dict[str, list[float]]
"""Times of a solver step, ms, over what is varied (`value`): on the cores of the settings, and on one beside them."""


def measure_scaling(
    arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings, permitted_force: float
) -> dict[str, Curve]:
    """Time of one solver step, ms, against k (elite and line search in proportion), H and nodes.

    What is not varied has the value of the settings; k and H are varied with one node, which is all in free space. If
    the settings have several cores, each time is taken in turns with that of one core. Then k is varied with most nodes
    too, and the cores with k candidates for each of them.
    """

    def with_candidates(count: int, cpus: int) -> PlanningSettings:
        return dataclasses.replace(settings, population=count, elite=count // 4, line_search_points=count, cpus=cpus)

    def candidates(nodes: int) -> list[tuple[float, PlanningSettings, int]]:
        return [(count, with_candidates(count, settings.cpus), nodes) for count in POPULATIONS]

    variants: dict[str, list[tuple[float, PlanningSettings, int]]] = {
        "k": candidates(1),
        "H": [(horizon, dataclasses.replace(settings, horizon=horizon), 1) for horizon in HORIZONS],
        "nodes": [(nodes, settings, nodes) for nodes in NODES],
    }
    if settings.cpus > 1:
        k, cores = settings.population, range(1, settings.cpus + 1)
        variants[f"k, {NODES[-1]} nodes"] = candidates(NODES[-1])
        variants["cores, k each"] = [(count, with_candidates(k * count, count), 1) for count in cores]
    curves: dict[str, Curve] = {}
    for name, entries in variants.items():
        curves[name] = {"value": [value for value, _, _ in entries], "step_ms": []}
        if settings.cpus > 1:
            curves[name]["one_core_ms"] = []
        for _, changed, nodes in entries:
            # One core comes last: the backend has as many devices as the first planner in a process asks for.
            alone = [] if settings.cpus == 1 else [dataclasses.replace(changed, cpus=1)]
            times = _step_ms(arm, [changed, *alone], gains, permitted_force, nodes)
            for key, time in zip(("step_ms", "one_core_ms"), times, strict=False):
                curves[name][key].append(time)
    return curves


def _step_ms(
    arm: Arm, settings: list[PlanningSettings], gains: ImpedanceSettings, permitted_force: float, nodes: int
) -> list[float]:
    """Median time of a solver step with each of the settings, ms, measured in turns.

    The arm goes from home to a goal nearby, with nodes out of its way.
    """
    q = np.array(arm.home)
    tip = link_frames(arm, q)[1][-1]
    centers = tip + np.array([0.6, 0.0, 0.0]) + 0.02 * np.arange(nodes)[:, None] * np.array([0.0, 0.0, 1.0])
    ones = np.ones(nodes)
    spheres = Spheres(centers, centers, 0.05 * ones, 100.0 * ones, 30.0 * ones)
    request = Request(q, np.zeros(arm.n), 0, 0, Target(tip + 0.1), spheres)
    settings = [dataclasses.replace(each, max_steps=_STEPS, stagnation_steps=_STEPS) for each in settings]
    planners = [RecordingPlanner(arm, each, gains, permitted_force, nodes) for each in settings]
    for planner in planners:
        planner.warm_up(lambda line: None)
    for _ in range(_ROUNDS):
        for planner in planners:
            planner.reset()
            planner.plan(request)
    return [
        float(np.median([1e3 * entry.solve.seconds / entry.plan.steps for entry in planner.recorded]))
        for planner in planners
    ]


def scaling_table(curves: dict[str, Any]) -> str:
    """A row for each curve, the times over what is varied; with several cores, also how many times as fast they are."""

    def joined(numbers: list[float], kind: str) -> str:
        return ", ".join(f"{number:{kind}}" for number in numbers)

    names = ["varied", "values", "one solver step, ms"]
    rows = [[name, joined(curve["value"], "g"), joined(curve["step_ms"], ".2f")] for name, curve in curves.items()]
    if "one_core_ms" in curves["k"]:
        names += ["on one core, ms", "times as fast"]
        for row, curve in zip(rows, curves.values(), strict=True):
            faster = np.divide(curve["one_core_ms"], curve["step_ms"]).tolist()
            row += [joined(curve["one_core_ms"], ".2f"), joined(faster, ".2f")]
    return table(names, rows)


def plot_scaling(curves: dict[str, Any], file: Path) -> None:
    """Draw the curves side by side, with zero on the axes."""
    labels = {"k": "candidates k", "H": "horizon H, knots", "nodes": "obstacle nodes"}
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, curve) in zip(np.ravel(figure.subplots(1, len(curves))), curves.items(), strict=True):
        if "one_core_ms" in curve:
            axes.plot(curve["value"], curve["one_core_ms"], marker="o", color=GREY, label="one core")
        axes.plot(curve["value"], curve["step_ms"], marker="o", color=BLUE, label="all cores")
        axes.set_xlabel(labels.get(name, name))
        axes.set_xlim(left=0.0)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    if "one_core_ms" in curves["k"]:
        figure.axes[0].legend()
    figure.axes[0].set_ylabel("one solver step, ms")
    figure.savefig(file, dpi=150)
