"""`contact-reach bench floor`: the least force with which an arm can get through a scene, whoever plans."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from contact_reach_ros.arms import load_arm
from contact_reach_ros.experiments.floor import Search, floor
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.output import Report, read_report, table, write_report
from contact_reach_ros.experiments.workers import run_all
from contact_reach_ros.experiments.workers import workers as make_workers
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.generate import load_scene

if TYPE_CHECKING:
    from distributed import Client


class Task(NamedTuple):
    """A scene and the seed of its target."""

    scene: str
    target: int


def find_floor(task: Task) -> Report:
    """The stations of `floor`."""
    scene = load_scene(task.scene, load_arm(), task.target)
    found = floor(scene, PlanningSettings().contact_stiffness, Search(), task.target)
    return {"target": task.target, "shares": [each.share for each in found], "force_N": [each.force for each in found]}


def bench_floor(
    scene: str = "wall",
    targets: int = 5,
    seed: int = 20,
    workers: int | None = None,
    scheduler: str | None = None,
    client: Client | None = None,
    file: Path | None = None,
) -> Report:
    """Find the floor of each target that `file` does not have yet, print a table and write JSON.

    Raises
    ------
    SceneError
        If the scene cannot be made.
    """
    done = read_report(file, "floor")["targets"] if file is not None and file.exists() else []
    tasks = [Task(scene, target) for target in range(seed, seed + targets)]
    tasks = [task for task in tasks if task.target not in {entry["target"] for entry in done}]
    report: Report = {"bench": "floor", "scene": scene, "machine": machine(), "targets": done}
    if tasks:
        with nullcontext(client) if client else make_workers(workers, scheduler) as own:
            for _, found in run_all(own, find_floor, tasks):
                if isinstance(found, BaseException):
                    raise found
                done.append(found)
                write_report(report, file)
    print(floor_table(report))
    return report


def floor_table(report: Report) -> str:
    """Least peak force on the way and at the goal, over the targets."""
    peaks = np.array([max(entry["force_N"]) for entry in report["targets"]])
    ends = np.array([entry["force_N"][-1] for entry in report["targets"]])
    where = np.array([entry["shares"][int(np.argmax(entry["force_N"]))] for entry in report["targets"]])
    rows = [
        [name, f"{values.mean():.2f}", f"{values.min():.2f} to {values.max():.2f}"]
        for name, values in (
            ("least peak force on the way, N", peaks),
            ("at this share of the way", where),
            ("least force at the goal, N", ends),
        )
    ]
    return table([f"{report['scene']}, {len(peaks)} targets", "mean", "range"], rows)
