"""`contact-reach bench setting`: whole episodes for each value of one of the planner's settings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.baselines.method import ReferenceMethod
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, EpisodeResult, run_episode
from contact_reach_ros.experiments.grid import episode_seeds
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.speed_limit import least_duration
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import sphere_capacity

LATENCY = "latency"
"""Not a setting of the planner: time between plans and from a state to the effect of its plan, s."""


def bench_setting(
    name: str, values: Sequence[Any], scenes: Sequence[str], targets: int, file: Path | None
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
    targets
        Seeds of each scene.

    Raises
    ------
    SettingsError
        If the setting is unknown or a value is out of range.
    """
    variants = [_variant(name, value) for value in values]
    permitted = load_budget().permitted_force
    report: dict[str, Any] = {"setting": name, "targets": targets, "machine": machine(), "scenes": {}}
    print(f"| scene | {name} | reached | time / limit | largest force, N | mean force, N | over the budget, ms |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for scene_name in scenes:
        scene_file = read_scene(scene_name)
        concrete = [make_scene(scene_file, seed) for seed in range(targets)]
        rows = report["scenes"][scene_file.name] = []
        for value, (settings, options) in zip(values, variants, strict=True):
            planner = RecedingHorizonPlanner(settings, ImpedanceSettings(), permitted, sphere_capacity(scene_file))
            method = ReferenceMethod(planner, ControllerSettings())
            results = [_episode(target, scene, method, options) for target, scene in enumerate(concrete)]
            row = {"value": value, **_summary(settings, concrete, results, permitted)}
            rows.append(row)
            ratio, force = row["time_ratio"], row["largest_force"]
            print(
                f"| {scene_file.name} | {value} | {row['reached']}/{targets} | {ratio['mean']:.2f} ± {ratio['sd']:.2f} "
                f"| {force['mean']:.1f} ± {force['sd']:.1f} | {row['mean_force']:.2f} | {row['over_budget_ms']:.0f} |",
                flush=True,
            )
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _episode(target: int, scene: Scene, method: ReferenceMethod, options: EpisodeOptions) -> EpisodeResult:
    """With random numbers of its own, as in Table I: episodes with the same ones would all be lucky, or none."""
    solver_seed, noise_seed = episode_seeds(target, 0)
    method.reseed(solver_seed)
    return run_episode(scene, method, dataclasses.replace(options, noise_seed=noise_seed))


def _variant(name: str, value: Any) -> tuple[PlanningSettings, EpisodeOptions]:
    """Settings with that value, and without a deadline, so that results do not depend on the machine."""
    options = EpisodeOptions(budget=load_budget())
    if name == LATENCY:
        return PlanningSettings(deadline=0.0), dataclasses.replace(options, latency=float(value), period=float(value))
    return PlanningSettings.from_mapping({"deadline": 0.0, name: value}, "bench setting"), options


def _summary(
    settings: PlanningSettings, scenes: Sequence[Scene], results: Sequence[EpisodeResult], permitted: float
) -> dict[str, Any]:
    ratios = [
        result.duration / least_duration(result.start_position, scene.target, settings, ImpedanceSettings())
        for scene, result in zip(scenes, results, strict=True)
        if result.reached
    ]
    peaks = [float(result.contact_forces.max()) for result in results]
    return {
        "reached": len(ratios),
        "time_ratio": {
            "mean": float(np.mean(ratios)) if ratios else float("nan"),
            "sd": float(np.std(ratios)) if ratios else float("nan"),
        },
        "largest_force": {"mean": float(np.mean(peaks)), "sd": float(np.std(peaks))},
        "mean_force": float(np.mean([result.contact_forces.mean() for result in results])),
        "over_budget_ms": float(np.mean([(result.contact_forces > permitted).sum() for result in results])),
    }
