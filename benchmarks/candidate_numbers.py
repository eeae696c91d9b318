"""How the time of a batch of candidates grows with their number, in this package's transfer model and in Brax's."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import jax
import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.experiments.output import Report, say, table
from contact_reach_ros.planning.action_space import ReferenceSpace, scaled_cost
from contact_reach_ros.planning.problem import Problem
from contact_reach_ros.planning.settings import PlanningSettings

_LONGEST = 60.0
"""Time that a batch may be expected to take, s; longer ones are left out."""


def measure_candidates(
    arm: Arm,
    problem: Problem,
    settings: PlanningSettings,
    gains: ImpedanceSettings,
    pipelines: Sequence[str],
    numbers: Sequence[int],
    rounds: int,
) -> Report:
    """Median time of a batch, ms, by pipeline and number of candidates, on the device that JAX computes on."""
    report: Report = {"device": jax.devices()[0].device_kind, "batch_ms": {}}
    for name in pipelines:
        space = ReferenceSpace(arm, dataclasses.replace(settings, pipeline=name), gains)
        cost = jax.jit(scaled_cost(space))
        measured = report["batch_ms"][name] = {}
        expected = 0.0
        for number in sorted(numbers):
            if expected * number > _LONGEST:
                say(f"{name}: {number} candidates left out, which would take {expected * number:.0f} s a batch")
                break
            random = np.random.default_rng(settings.seed)
            points = random.uniform(-1.0, 1.0, (len(space.bounds), number)).astype(np.float32)
            say(f"{name}: {number} candidates")
            jax.block_until_ready(cost(problem, points))
            times = []
            for _ in range(rounds):
                began = time.perf_counter()
                jax.block_until_ready(cost(problem, points))
                times.append(time.perf_counter() - began)
            measured[number] = 1e3 * float(np.median(times))
            expected = float(np.median(times)) / number
    return report


def candidates_table(report: Report, scenes: Sequence[str]) -> str:
    """A table in Markdown: one row for each scene, pipeline and number."""
    rows = []
    for scene in scenes:
        found = report[scene]["candidates"]
        for name, measured in found["batch_ms"].items():
            rows += [
                [scene, found["device"], name, str(number), f"{value:.2f}", f"{1e3 * value / number:.2f}"]
                for number, value in measured.items()
            ]
    return table(["scene", "device", "pipeline", "candidates", "batch, ms", "candidate, µs"], rows)
