"""`contact-reach bench contact-weight`: what a cost on permitted contact brings, and what it takes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.episode import EpisodeOptions, EpisodeResult, run_episode
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import Scene, read_scene
from contact_reach_ros.scenes.spheres import sphere_capacity

WEIGHTS = (0.0, 0.0003, 0.001, 0.003, 0.01, 0.03)


def bench_contact_weight(
    scenes: Sequence[str], targets: int, weights: Sequence[float], file: Path | None
) -> dict[str, Any]:
    """Run whole episodes with each weight, print a table in Markdown and write JSON to `file`.

    Parameters
    ----------
    scenes
        Names or YAML files.
    targets
        Seeds of each scene.
    weights
        Of contact forces within the budget, 1/N.
    """
    settings = PlanningSettings(deadline=0.0)
    permitted = load_budget("").permitted_force
    report: dict[str, Any] = {"targets": targets, "scenes": {}}
    print("| scene | weight, 1/N | reached | time / limit | largest force, N | mean force, N | over the budget, ms |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in scenes:
        scene_file = read_scene(name)
        planner = RecedingHorizonPlanner(settings, ImpedanceSettings(), permitted, sphere_capacity(scene_file))
        concrete = [make_scene(scene_file, seed) for seed in range(targets)]
        rows = report["scenes"][name] = []
        for weight in weights:
            planner.change_weights(dataclasses.replace(settings, contact_weight=weight), permitted)
            results = [run_episode(scene, planner, EpisodeOptions()) for scene in concrete]
            row = {"weight": weight, **_summary(concrete, results, permitted)}
            rows.append(row)
            ratio, force = row["time_ratio"], row["largest_force"]
            print(
                f"| {name} | {weight:g} | {row['reached']}/{targets} | {ratio['mean']:.2f} ± {ratio['sd']:.2f} | "
                f"{force['mean']:.1f} ± {force['sd']:.1f} | {row['mean_force']:.2f} | {row['over_budget_ms']:.0f} |",
                flush=True,
            )
    if file is not None:
        file.write_text(json.dumps(report, indent=2) + "\n")
    return report


def _summary(scenes: Sequence[Scene], results: Sequence[EpisodeResult], permitted: float) -> dict[str, Any]:
    settings, gains = PlanningSettings(), ImpedanceSettings()
    # With these gains no axis of the flange moves faster, since γ bounds Δx.
    fastest = settings.translation_bound * gains.task_stiffness / gains.task_damping
    ratios = [
        result.duration / (np.abs(scene.target - result.plans[0].predicted_positions[0]).max() / fastest)
        for scene, result in zip(scenes, results, strict=True)
    ]
    peaks = [float(result.contact_forces.max()) for result in results]
    return {
        "reached": sum(result.reached for result in results),
        "time_ratio": {"mean": float(np.nanmean(ratios)), "sd": float(np.nanstd(ratios))},
        "largest_force": {"mean": float(np.mean(peaks)), "sd": float(np.std(peaks))},
        "mean_force": float(np.mean([result.contact_forces.mean() for result in results])),
        "over_budget_ms": float(np.mean([(result.contact_forces > permitted).sum() for result in results])),
    }
