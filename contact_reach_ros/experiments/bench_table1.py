"""`contact-reach bench table1`: the paper's Table I, compared with the paper and with our own requirements."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from contact_reach_ros.arms import DEFAULT_ARM, load_arm
from contact_reach_ros.control.controller import ControllerSettings
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.baselines.methods import METHODS
from contact_reach_ros.experiments.grid import (
    GOALS,
    Cell,
    EpisodeTask,
    Record,
    Setup,
    by_program,
    cell_of,
    cells,
    concrete_scene,
    failed,
    reason,
    run_cell,
)
from contact_reach_ros.experiments.latency import LatencyTask, measure_latencies, rounded_up
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.output import Report, read_report, say, write_report, write_whole
from contact_reach_ros.experiments.table1_report import document, tables
from contact_reach_ros.experiments.workers import run_all, workers
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.scene import SceneFile

if TYPE_CHECKING:
    from distributed import Client
from contact_reach_ros.experiments.table1_resume import (
    check_same,
    partial_of,
    read_earlier,
    refuse_to_drop,
    refuse_to_lose,
)

SCENES = ("free", "ball", "wall", "ball_mismatch", "wall_mismatch")
"""In the order of the paper's table."""


@dataclass(frozen=True)
class Table1:
    """What is run.

    Attributes
    ----------
    scenes
        Names or YAML files.
    goals, methods
        Some of `GOALS` and `METHODS`.
    targets, repeats
        Targets per scene, with the seeds `seed`, `seed` + 1, ..., and repeats of each with other random numbers.
    timeout
        Time to reach the goal, simulated, s.
    latency
        Latency of the plans, s; measured if None.
    workers
        Processes on this machine; one per core if None.
    scheduler
        Address of a Dask scheduler whose workers run the episodes instead.
    arm
        Name of an arm, or path of its file.
    task
        What law (1) controls: 'pose' or 'position'.
    """

    scenes: tuple[str, ...] = SCENES
    goals: tuple[str, ...] = GOALS
    methods: tuple[str, ...] = tuple(METHODS)
    targets: int = 10
    repeats: int = 3
    seed: int = 0
    timeout: float = 20.0
    latency: float | None = None
    workers: int | None = None
    scheduler: str | None = None
    arm: str = DEFAULT_ARM
    task: str = "pose"


def bench_table1(
    bench: Table1, file: Path | None, results: Path | None, resume: bool, setup: Setup | None = None
) -> Report:
    """Run the episodes, print the table in Markdown, write JSON to `file` and the page of results to `results`.

    Finished episodes are kept beside `file` while it runs; `resume` continues from there, or from `file` itself.

    Raises
    ------
    SettingsError
        If an option is out of range, or the run to be resumed has other settings.
    SceneError
        If a scene cannot be made.
    """
    _check(bench, file, resume)
    controller = ControllerSettings(impedance=ImpedanceSettings(task=bench.task))
    setup = setup or Setup(bench.arm, controller=controller, budget=load_budget())
    setup = dataclasses.replace(setup, timeout=bench.timeout)
    scenes = _read_scenes(bench)
    header = _header(bench, setup, scenes)
    latencies, done = read_earlier(file, header) if resume else ({}, {})
    refuse_to_lose(file, resume)
    grid = cells(
        scenes, bench.goals, bench.methods, range(bench.seed, bench.seed + bench.targets), range(bench.repeats)
    )
    refuse_to_drop(file, grid, done)
    # A scene that cannot be made is found before hours are spent on the others.
    for name, target in dict.fromkeys((cell.scene, cell.target) for cell in grid if cell not in done):
        concrete_scene(scenes[name], load_arm(setup.arm), target)

    def report() -> Report:
        return {**header, "latencies": latencies, "episodes": [done[cell] for cell in grid if cell in done]}

    partial = None if file is None else partial_of(file)
    todo = [cell for cell in grid if cell not in done]
    if todo:
        with workers(bench.workers, bench.scheduler) as client:
            _add_latencies(client, bench, scenes, setup, todo, latencies)
            tasks = [
                EpisodeTask(cell, scenes[cell.scene], latencies[cell.scene][cell.method]["latency_s"], setup)
                for cell in todo
            ]
            write_report(report(), partial)
            try:
                for _ in _run(client, tasks, done):
                    write_report(report(), partial)
            except BaseException:
                if partial is not None:
                    say(
                        f"interrupted: {len(done)} of {len(grid)} episodes are in {partial}; --resume goes on with them"
                    )
                raise
    write_report(report(), file)
    if partial is not None:
        partial.unlink(missing_ok=True)
    show(report(), results)
    return report()


def report_table1(file: Path, results: Path | None, other: Path | None = None) -> Report:
    """Print the table of a finished run and write the page of results, from its JSON alone.

    `other`: the JSON of a run with other goals; the page then compares the two conditions.

    Raises
    ------
    SettingsError
        If there is no such file, it holds no finished run, or the two runs have different settings.
    """
    report = read_report(file, "table1")
    second = None if other is None else read_report(other, "table1")
    if second is not None:
        check_same(report["settings"], second["settings"], str(file))
    show(report, results, second)
    return report


def show(report: Report, results: Path | None, other: Report | None = None) -> None:
    """Print the table and write the page of results."""
    print(tables(report))
    if results is not None:
        write_whole(results, document(report, results, other))


def _check(bench: Table1, file: Path | None, resume: bool) -> None:
    for name, values, known in (("goals", bench.goals, GOALS), ("methods", bench.methods, tuple(METHODS))):
        for value in values:
            if value not in known:
                raise SettingsError(f"--{name} '{value}' is unknown; expected one of {', '.join(known)}")
    for name, number, least in (
        ("targets", bench.targets, 1),
        ("repeats", bench.repeats, 1),
        ("seed", bench.seed, 0),
        ("workers", 1 if bench.workers is None else bench.workers, 1),
    ):
        if number < least:
            raise SettingsError(f"--{name} {number}: expected at least {least}")
    if not bench.timeout > 0.0:
        raise SettingsError(f"--timeout {bench.timeout:g}: expected a positive time in s")
    if bench.latency is not None and not 0.001 <= bench.latency <= 1.0:
        raise SettingsError(f"--latency {bench.latency:g}: expected 0.001 to 1 s")
    if resume and file is None:
        raise SettingsError("--resume needs --json FILE, the file of the run to go on with")


def _read_scenes(bench: Table1) -> dict[str, SceneFile]:
    scenes: dict[str, SceneFile] = {}
    for name in bench.scenes:
        scene = read_scene(name)
        if scene.name in scenes and scenes[scene.name] != scene:
            raise SettingsError(f"--scenes: two files are named '{scene.name}'; rename one of them")
        scenes[scene.name] = scene
    return scenes


def _header(bench: Table1, setup: Setup, scenes: dict[str, SceneFile]) -> Report:
    """Everything known before the run, in the types that JSON returns."""
    options = setup.options(paper.METHOD, GOALS[0], latency=0.1)
    header = {
        "bench": "table1",
        "command": command(bench),
        "grid": {
            "scenes": list(scenes),
            "goals": list(bench.goals),
            "methods": list(bench.methods),
            "targets": bench.targets,
            "repeats": bench.repeats,
            "seed": bench.seed,
        },
        "settings": {
            **dataclasses.asdict(setup),
            "success": options.success,
            "settle": options.settle,
            "sensors": dataclasses.asdict(options.sensors),
            "joints": dataclasses.asdict(options.joints),
            "scenes": {name: dataclasses.asdict(scene) for name, scene in scenes.items()},
        },
        "machine": machine(),
    }
    return json.loads(json.dumps(header))


def command(bench: Table1) -> str:
    """The command line of a run, without options that do not change its results."""
    words = ["contact-reach", "bench", "table1"]
    standard = Table1()
    for name in ("scenes", "goals", "methods"):
        if getattr(bench, name) != getattr(standard, name):
            words += [f"--{name}", *(Path(value).name for value in getattr(bench, name))]
    for name in ("arm", "task", "targets", "repeats", "seed", "timeout", "latency"):
        value = getattr(bench, name)
        if value != getattr(standard, name):
            words += [f"--{name}", value if isinstance(value, str) else f"{value:g}"]
    return shlex.join(words)


def _add_latencies(
    client: Client,
    bench: Table1,
    scenes: dict[str, SceneFile],
    setup: Setup,
    todo: Sequence[Cell],
    latencies: dict[str, Any],
) -> None:
    """Measure the latencies that the cells need, one at a time on otherwise idle workers."""
    for scene, method in dict.fromkeys((cell.scene, cell.method) for cell in todo):
        known = latencies.setdefault(scene, {})
        if bench.latency is not None:
            given = {"latency_s": rounded_up(bench.latency), "median_s": None, "cpu_median_s": None, "plans": 0}
            if known.get(method, given) != given:
                raise SettingsError(
                    f"--latency {bench.latency:g}: the earlier episodes of {method} in {scene} were run with "
                    f"{known[method]['latency_s']:g} s; leave --latency out, or begin another file"
                )
            known[method] = given
    missing = dict.fromkeys((c.method, c.scene) for c in todo if c.method not in latencies[c.scene])
    tasks = [LatencyTask(scenes[scene], method, bench.seed, setup) for method, scene in sorted(missing)]
    for task, found in measure_latencies(client, tasks):
        latencies[task.scene.name][task.method] = found
        say(f"{task.scene.name}, {task.method}: a plan takes {1e3 * found['latency_s']:.0f} ms")


def _run(client: Client, tasks: list[EpisodeTask], done: dict[Cell, Record]) -> Iterator[None]:
    """Run the tasks; yields after each of them, with its record among those that are `done`."""
    total = len(done) + len(tasks)
    # On the error output, which leaves the table alone.
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("episodes", total=total, completed=len(done))
        for task, found in run_all(client, run_cell, by_program(tasks)):
            record = failed(task.cell, reason(found)) if isinstance(found, BaseException) else found
            done[task.cell] = record
            line = f"{len(done)}/{total} {_line(record)}"
            progress.console.print(line, markup=False, highlight=False, soft_wrap=True)
            progress.advance(bar)
            yield


def _line(record: Record) -> str:
    cell = cell_of(record)
    start = f"{cell.scene}, {cell.goal}, {cell.method}, target {cell.target}, repeat {cell.repeat}:"
    if record["reached"]:
        return f"{start} {record['time']:.2f} s, {record['max_contact_force']:.2f} N"
    return f"{start} not reached, {record['stop_reason'] or record['failure'] or 'out of time'}"
