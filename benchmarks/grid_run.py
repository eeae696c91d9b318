"""Runs of many episodes, kept in one JSON file, which go on where they were interrupted."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from benchmarks import paper
from benchmarks.grid import (
    GOALS,
    Cell,
    EpisodeTask,
    Record,
    Setup,
    cell_of,
    concrete_scene,
    run_cell,
)
from benchmarks.output import Report, machine, read_report, say, write_report
from benchmarks.workers import run_each
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.world.scene_file import SceneFile


@dataclasses.dataclass(frozen=True)
class Running:
    """How a grid is run.

    Attributes
    ----------
    file
        JSON file of the run, which goes on with the episodes of an earlier one; None for none. Finished episodes are
        beside it until the run ends, see `partial_of`.
    workers
        Processes; one per core if None.
    """

    file: Path | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"--workers {self.workers}: expected at least 1")

    @classmethod
    def of(cls, options: dict[str, Any]) -> Running:
        """Take the options of `output.command_line` out of those given."""
        names = [field.name for field in dataclasses.fields(cls) if field.name in options]
        return cls(**{name: options.pop(name) for name in names})


def run_grid(
    bench: str,
    description: Report,
    setup: Setup,
    scenes: Mapping[str, SceneFile],
    grid: Sequence[Cell],
    running: Running,
    latency: float | None = None,
    variants: Mapping[str, Setup] | None = None,
) -> Report:
    """Run the cells that are not done; returns a report with settings and all episodes, without writing it.

    Parameters
    ----------
    bench, description
        Name of the benchmark, and further entries of its report.
    latency
        Of all plans, s, instead of the setup's.
    variants
        Setups of the cells that name one of them; the others have `setup`.

    Raises
    ------
    SettingsError
        If the file holds a run with other settings, or episodes that these options leave out.
    SceneError
        If a scene cannot be made.
    """
    file, variants = running.file, variants or {}
    header = _header(bench, description, setup, scenes, latency, variants)
    done = _earlier(bench, file, header) if file is not None else {}
    outside = sorted(set(done) - set(grid), key=dataclasses.astuple)
    if outside:
        raise SettingsError(
            f"{file}: holds {len(outside)} episodes that these options leave out, such as {outside[0]}: go on with the "
            "options of that run or with more, or begin another file"
        )
    todo = [cell for cell in grid if cell not in done]
    # A scene that cannot be made is found before hours are spent on the others.
    for name, target in dict.fromkeys((cell.scene, cell.target) for cell in todo):
        concrete_scene(scenes[name], load_arm(setup.arm), target)
    tasks = []
    for cell in todo:
        each = variants.get(cell.variant, setup)
        tasks.append(EpisodeTask(cell, scenes[cell.scene], latency or each.latency(cell.method), each))

    def report() -> Report:
        return {**header, "episodes": [done[cell] for cell in grid if cell in done]}

    if tasks:
        _run(tasks, done, report, running)
    return report()


def finish(report: Report, file: Path | None) -> None:
    """Write the report of a finished run and remove that of the unfinished one."""
    write_report(report, file)
    if file is not None:
        partial_of(file).unlink(missing_ok=True)


def partial_of(file: Path) -> Path:
    """The file with the report of an unfinished run, beside that of the finished one."""
    return file.with_name(f"{file.name}.partial")


def _header(
    bench: str,
    description: Report,
    setup: Setup,
    scenes: Mapping[str, SceneFile],
    latency: float | None,
    variants: Mapping[str, Setup],
) -> Report:
    """Everything known before the run, in the types that JSON returns."""
    options = setup.options(paper.METHOD, GOALS[0], latency=0.1)
    header = {
        "bench": bench,
        **description,
        "settings": {
            **dataclasses.asdict(setup),
            "latency": latency,
            "success": options.success,
            "settle": options.settle,
            "sensors": dataclasses.asdict(options.sensors),
            "joints": dataclasses.asdict(options.joints),
            "scenes": {name: dataclasses.asdict(scene) for name, scene in scenes.items()},
            "variants": {name: dataclasses.asdict(each) for name, each in variants.items()},
        },
        "machine": machine(),
    }
    return json.loads(json.dumps(header))


def _earlier(bench: str, file: Path, header: Report) -> dict[Cell, Record]:
    """Episodes of an unfinished or finished run with the same settings, if there is one."""
    source = next((path for path in (partial_of(file), file) if path.exists()), None)
    if source is None:
        return {}
    earlier = read_report(source, bench)
    _check_same(earlier["settings"], header["settings"], str(source))
    header["machine"] = earlier["machine"]
    return {cell_of(record): record for record in earlier["episodes"]}


def _check_same(earlier: Any, now: Any, where: str) -> None:
    """Raise `SettingsError` if a setting that both runs have differs; `where` and the setting are named."""
    if isinstance(earlier, dict) and isinstance(now, dict):
        for key in earlier.keys() & now.keys():
            _check_same(earlier[key], now[key], f"{where}: {key}")
    elif earlier != now:
        raise SettingsError(
            f"{where} was {earlier!r} and is {now!r} now: a run can only go on with the settings it began with; set it "
            "back, or begin another file"
        )


def _run(tasks: list[EpisodeTask], done: dict[Cell, Record], report: Callable[[], Report], running: Running) -> None:
    """Run the tasks; after each of them, its record is among those `done`, and the unfinished report is written."""
    total = len(done) + len(tasks)
    partial = None if running.file is None else partial_of(running.file)
    # On the error output, which leaves the table alone.
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("episodes", total=total, completed=len(done))
        try:
            write_report(report(), partial)
            for record in run_each(run_cell, tasks, running.workers):
                done[cell_of(record)] = record
                write_report(report(), partial)
                line = f"{len(done)}/{total} {_line(record)}"
                progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
                progress.advance(bar)
        except BaseException:
            if partial is not None:
                say(
                    f"interrupted: {len(done)} of {total} episodes are in {partial}; the same command goes on with them"
                )
            raise


def _line(record: Record) -> str:
    cell = cell_of(record)
    parts = (cell.variant, cell.scene, cell.goal, cell.method, f"target {cell.target}, repeat {cell.repeat}:")
    start = ", ".join(part for part in parts if part)
    if record["reached"]:
        return f"{start} {record['time']:.2f} s, {record['max_contact_force']:.2f} N"
    return f"{start} not reached, {record['stop_reason'] or record['failure'] or 'out of time'}"
