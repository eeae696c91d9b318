"""`contact-reach bench setting`: whole episodes for each value of one of the planner's settings."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.drawing.palette import BLUE, GREEN, ORANGE, VERMILION
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments.baselines.method import Method
from contact_reach_ros.experiments.baselines.methods import make_method
from contact_reach_ros.experiments.episode import EpisodeOptions, run_episode
from contact_reach_ros.experiments.episode_result import EpisodeResult
from contact_reach_ros.experiments.grid import episode_seeds
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.metrics import measure
from contact_reach_ros.experiments.output import say, write_report
from contact_reach_ros.experiments.paper import METHOD
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.generate import make_scene
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import sphere_capacity

LATENCY = "latency"
"""Not a setting of the planner: time between plans and from a state to the effect of its plan, s."""


_COLOURS = (BLUE, VERMILION, GREEN, ORANGE)


def bench_setting(
    name: str,
    values: Sequence[Any],
    scenes: Sequence[str] = ("ball", "wall"),
    methods: Sequence[str] = (METHOD,),
    targets: int = 10,
    seed: int = 0,
    others: Sequence[str] = (),
    spheres: int | None = None,
    arm: str = DEFAULT_ARM,
    file: Path | None = None,
    plot: Path | None = None,
) -> dict[str, Any]:
    """Run episodes, print a table in Markdown and write JSON to `file`.

    Parameters
    ----------
    name
        Of a field of `PlanningSettings`, or `LATENCY`.
    values
        That it takes.
    scenes
        Names or YAML files.
    methods
        Some of `METHODS`.
    targets, seed
        Number of seeds of each scene, and the first.
    others
        Other settings, as in population=32; the same for each value.
    spheres
        Number of spheres that plans take into account; by default that of the scene.
    arm
        Name of an arm, or path of its file.
    plot
        Picture of time and peak force over the values.

    Raises
    ------
    SettingsError
        If the setting is unknown or a value is out of range.
    """
    variants = [_variant({**_assignments(others), name: value}) for value in values]
    moved, permitted = load_arm(arm), load_budget().permitted_force
    report: dict[str, Any] = {
        "setting": name,
        "arm": moved.name,
        "targets": targets,
        "machine": machine(),
        "scenes": {},
    }
    print(f"| scene | method | {name} | settled | time / limit | peak force, N | mean force, N | over the budget, ms |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for scene_name in scenes:
        scene_file = read_scene(scene_name)
        concrete = {target: make_scene(scene_file, moved, target) for target in range(seed, seed + targets)}
        rows = report["scenes"][scene_file.name] = []
        for method_name, (value, (settings, options)) in product(methods, zip(values, variants, strict=True)):
            capacity = sphere_capacity(scene_file) if spheres is None else spheres
            method = make_method(moved, method_name, capacity, permitted, 0, settings)
            method.warm_up(say)
            begin = time.perf_counter()
            results = [_episode(target, scene, method, options) for target, scene in concrete.items()]
            row = {"method": method_name, "value": value}
            row |= _summary(settings, list(concrete.values()), results, permitted)
            row["wall_s"] = time.perf_counter() - begin
            rows.append(row)
            ratio, force = row["time_ratio"], row["largest_force"]
            print(
                f"| {scene_file.name} | {method_name} | {value} | {row['reached']}/{targets} "
                f"| {ratio['mean']:.2f} ± {ratio['sd']:.2f} | {force['mean']:.1f} ± {force['sd']:.1f} "
                f"| {row['mean_force']:.2f} | {row['over_budget_ms']:.0f} |",
                flush=True,
            )
            write_report(report, file)
    took = ", ".join(
        f"{scene} {row['value']} {row['wall_s'] / targets:.0f} s"
        for scene, rows in report["scenes"].items()
        for row in rows
    )
    print(f"\nTime of an episode: {took}")
    if plot is not None:
        _plot(report, plot)
    return report


def _plot(report: dict[str, Any], file: Path) -> None:
    """Draw settling time and peak force over the values, evenly spaced, one row of charts for each scene."""
    figure = Figure((9.0, 1.0 + 2.6 * len(report["scenes"])), layout="constrained")
    grid = figure.subplots(len(report["scenes"]), 2, squeeze=False)
    for (scene, rows), line in zip(report["scenes"].items(), grid, strict=True):
        for axes, figure_name, label in zip(
            line, ("largest_force", "time_ratio"), ("peak force, N", "time to settle / limit"), strict=True
        ):
            for method, colour in zip(dict.fromkeys(row["method"] for row in rows), _COLOURS, strict=False):
                own = [row for row in rows if row["method"] == method]
                means = [row[figure_name]["mean"] for row in own]
                bars = axes.errorbar(
                    range(len(own)),
                    means,
                    [row[figure_name]["sd"] for row in own],
                    color=colour,
                    capsize=3,
                    label=method,
                )
                bars[0].set_marker("o")
                if figure_name == "time_ratio":
                    continue
                for place, row in enumerate(own):
                    if row["reached"] < report["targets"]:
                        text = f"{row['reached']}/{report['targets']}"
                        axes.annotate(text, (place, means[place]), (4, 4), textcoords="offset points", color=colour)
            axes.set(title=scene, xlabel=report["setting"], ylabel=label)
            axes.set_xticks(range(len(own)), [f"{row['value']:g}" for row in own])
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
        line[0].legend()
    FigureCanvasAgg(figure).print_png(file)


def _episode(target: int, scene: Scene, method: Method, options: EpisodeOptions) -> EpisodeResult:
    """With random numbers of its own, as in Table I: episodes with the same ones would all be lucky, or none."""
    solver_seed, noise_seed = episode_seeds(target, 0)
    method.reseed(solver_seed)
    return run_episode(scene, method, dataclasses.replace(options, noise_seed=noise_seed))


def _assignments(pairs: Sequence[str]) -> dict[str, Any]:
    """Values by name, from texts such as population=32."""
    split = [pair.partition("=") for pair in pairs]
    wrong = [pair for pair, (name, _, value) in zip(pairs, split, strict=True) if not (name and value)]
    if wrong:
        raise SettingsError(f"--with {' '.join(wrong)}: expected NAME=VALUE, as in population=32")
    return {name: yaml.safe_load(value) for name, _, value in split}


def _variant(values: Mapping[str, Any]) -> tuple[PlanningSettings, EpisodeOptions]:
    """Settings with these values, and without a deadline, so that results do not depend on the machine."""
    planning = {"deadline": 0.0, **values}
    options = EpisodeOptions(budget=load_budget(), until_settled=True)
    if LATENCY in planning:
        # As in Table I, the next plan is begun when the last one is ready.
        latency = float(planning.pop(LATENCY))
        options = dataclasses.replace(options, latency=latency, period=latency)
    return PlanningSettings.from_mapping(planning, "bench setting"), options


def _summary(
    settings: PlanningSettings, scenes: Sequence[Scene], results: Sequence[EpisodeResult], permitted: float
) -> dict[str, Any]:
    measured = [
        measure(result, scene.target, settings, ImpedanceSettings(), permitted)
        for scene, result in zip(scenes, results, strict=True)
    ]
    ratios = [metrics.time_ratio for metrics in measured if metrics.time_ratio is not None]
    return {
        "reached": len(ratios),
        "time_ratio": _mean_and_deviation(ratios),
        "largest_force": _mean_and_deviation([metrics.max_contact_force for metrics in measured]),
        "mean_force": float(np.mean([result.contact_forces.mean() for result in results])),
        "over_budget_ms": 1e3 * float(np.mean([metrics.over_budget for metrics in measured])),
    }


def _mean_and_deviation(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {"mean": float("nan"), "sd": float("nan")}
    return {"mean": float(np.mean(values)), "sd": float(np.std(values))}
