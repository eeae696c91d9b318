"""How the time of a solver step grows with candidates, horizon, obstacle nodes and cores."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.drawing.palette import BLUE
from contact_reach_ros.experiments.output import table
from contact_reach_ros.experiments.recorded_runs import RecordingPlanner
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

POPULATIONS = (50, 100, 200, 400)
HORIZONS = (1, 3, 5)
NODES = (0, 1, 4, 12, 24)

_STEPS = 10
_ROUNDS = 3

Curve = dict[str, list[float]]


def measure_scaling(
    arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings, permitted_force: float
) -> dict[str, Curve]:
    """Time of one solver step, ms, against k (elite and line search in proportion), H and nodes.

    What is not varied has the value of the settings; k and H are varied with one node, which is all in free space. If
    the settings have several cores, the time against these too: with k of the settings for all of them together, and
    for each of them.
    """

    def with_candidates(count: int, cpus: int) -> PlanningSettings:
        return dataclasses.replace(settings, population=count, elite=count // 4, line_search_points=count, cpus=cpus)

    own, cores = settings.population, range(1, settings.cpus + 1) if settings.cpus > 1 else ()
    variants: dict[str, list[tuple[float, PlanningSettings, int]]] = {
        "k": [(count, with_candidates(count, settings.cpus), 1) for count in POPULATIONS],
        "H": [(horizon, dataclasses.replace(settings, horizon=horizon), 1) for horizon in HORIZONS],
        "nodes": [(nodes, settings, nodes) for nodes in NODES],
        "cores, k together": [(count, with_candidates(own, count), 1) for count in cores],
        "cores, k each": [(count, with_candidates(own * count, count), 1) for count in cores],
    }
    curves: dict[str, Curve] = {}
    for name, entries in variants.items():
        if not entries:
            continue
        times = [_step_ms(arm, changed, gains, permitted_force, nodes) for _, changed, nodes in entries]
        curves[name] = {"value": [value for value, _, _ in entries], "step_ms": times}
    return curves


def _step_ms(
    arm: Arm, settings: PlanningSettings, gains: ImpedanceSettings, permitted_force: float, nodes: int
) -> float:
    """Median time of a solver step from home to a goal nearby, ms, with nodes out of the arm's way."""
    settings = dataclasses.replace(settings, max_steps=_STEPS, stagnation_steps=_STEPS)
    planner = RecordingPlanner(arm, settings, gains, permitted_force, nodes)
    q = np.array(arm.home)
    tip = link_frames(arm, q)[1][-1]
    centers = tip + np.array([0.6, 0.0, 0.0]) + 0.02 * np.arange(nodes)[:, None] * np.array([0.0, 0.0, 1.0])
    ones = np.ones(nodes)
    spheres = Spheres(centers, centers, 0.05 * ones, 100.0 * ones, 30.0 * ones)
    planner.warm_up(lambda line: None)
    for _ in range(_ROUNDS):
        planner.reset()
        planner.plan(Request(q, np.zeros(arm.n), 0, 0, Target(tip + 0.1), spheres))
    return float(np.median([1e3 * entry.solve.seconds / entry.plan.steps for entry in planner.recorded]))


def scaling_table(curves: dict[str, Any]) -> str:
    """A row for each curve, the times over what is varied."""
    rows = [
        (name, ", ".join(f"{value:g}" for value in curve["value"]), ", ".join(f"{ms:.2f}" for ms in curve["step_ms"]))
        for name, curve in curves.items()
    ]
    return table(["varied", "values", "one solver step, ms"], rows)


def plot_scaling(curves: dict[str, Any], file: Path) -> None:
    """Draw the curves side by side, with zero on the axes."""
    labels = {"k": "candidates k", "H": "horizon H, knots", "nodes": "obstacle nodes"}
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    highest = max(max(curve["step_ms"]) for curve in curves.values())
    for axes, (name, curve) in zip(np.ravel(figure.subplots(1, len(curves))), curves.items(), strict=True):
        axes.plot(curve["value"], curve["step_ms"], marker="o", color=BLUE)
        axes.set_xlabel(labels.get(name, name))
        axes.set_ylim(0.0, 1.1 * math.ceil(highest))
        axes.set_xlim(left=0.0)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("one solver step, ms")
    figure.savefig(file, dpi=150)
