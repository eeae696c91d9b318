"""Runs of many episodes on the processes of this machine."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from benchmarks import paper
from benchmarks.grid import GOALS, Cell, EpisodeTask, Record, Setup, cell_of, concrete_scene, run_cell
from benchmarks.output import Report, machine
from benchmarks.workers import run_each
from contact_reach_ros.arms import load_arm
from contact_reach_ros.world.scene_file import SceneFile


def run_grid(
    bench: str,
    description: Report,
    setup: Setup,
    scenes: Mapping[str, SceneFile],
    grid: Sequence[Cell],
    workers: int | None = None,
    latency: float | None = None,
    variants: Mapping[str, Setup] | None = None,
) -> Report:
    """Run all cells; returns a report with settings and episodes in the order of the cells.

    Parameters
    ----------
    bench, description
        Name of the benchmark, and further entries of its report.
    workers
        Processes; one per core if None.
    latency
        Of all plans, s, instead of the setup's.
    variants
        Setups of the cells that name one of them; the others have `setup`.

    Raises
    ------
    SceneError
        If a scene cannot be made.
    """
    variants = variants or {}
    # A scene that cannot be made is found before hours are spent on the others.
    for name, target in dict.fromkeys((cell.scene, cell.target) for cell in grid):
        concrete_scene(scenes[name], load_arm(setup.arm), target)
    tasks = []
    for cell in grid:
        each = variants.get(cell.variant, setup)
        tasks.append(EpisodeTask(cell, scenes[cell.scene], latency or each.latency(cell.method), each))
    done: dict[Cell, Record] = {}
    # On the error output, which leaves the table alone.
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("episodes", total=len(tasks))
        for record in run_each(run_cell, tasks, workers):
            done[cell_of(record)] = record
            line = f"{len(done)}/{len(tasks)} {_line(record)}"
            progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
            progress.advance(bar)
    options = setup.options(paper.METHOD, GOALS[0], latency=0.1)
    report = {
        "bench": bench,
        **description,
        "settings": {
            **dataclasses.asdict(setup),
            "latency": latency,
            "tolerance": options.tolerance,
            "settle": options.settle,
            "scenes": {name: dataclasses.asdict(scene) for name, scene in scenes.items()},
            "variants": {name: dataclasses.asdict(each) for name, each in variants.items()},
        },
        "machine": machine(),
        "episodes": [done[cell] for cell in grid],
    }
    return json.loads(json.dumps(report))


def _line(record: Record) -> str:
    cell = cell_of(record)
    parts = (cell.variant, cell.scene, cell.goal, cell.method, f"target {cell.target}, repeat {cell.repeat}:")
    start = ", ".join(part for part in parts if part)
    if record["reached"]:
        return f"{start} {record['time']:.2f} s, {record['max_contact_force']:.2f} N"
    return f"{start} not reached, {record['stop_reason'] or record['failure'] or 'out of time'}"
