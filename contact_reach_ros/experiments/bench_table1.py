"""`contact-reach bench table1`: the paper's Table I, and what is demanded of it."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from contact_reach_ros.baselines.methods import METHODS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments import paper
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
from contact_reach_ros.experiments.journal import Journal, journal_of, read_journal, write_whole
from contact_reach_ros.experiments.latency import LatencyTask, measure_latency, rounded_up
from contact_reach_ros.experiments.machine import machine
from contact_reach_ros.experiments.table1_report import document, tables
from contact_reach_ros.experiments.workers import Crew, DaskCrew, ProcessCrew, run_all
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.scene import SceneFile

Report = dict[str, Any]

SCENES = ("free", "ball", "wall", "ball_mismatch", "wall_mismatch")
"""In the order of the paper's table."""

_TERMINATED = 128 + signal.SIGTERM


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
        To reach the goal, s of simulated time.
    latency
        Of the plans, s; measured if there is none.
    workers
        Processes.
    scheduler
        Address of a Dask scheduler that has the workers instead.
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


def bench_table1(
    bench: Table1, file: Path | None, results: Path | None, resume: bool, setup: Setup | None = None
) -> Report:
    """Run the episodes, print the table in Markdown, write JSON to `file` and the page of results to `results`.

    While it runs, what is finished is kept beside `file`; `resume` goes on from there, or from `file` itself.

    Raises
    ------
    SettingsError
        If an option is out of range, or what is to be resumed was run with other settings.
    SceneError
        If a scene cannot be made.
    """
    _check(bench, file, resume)
    setup = dataclasses.replace(setup or Setup(budget=load_budget()), timeout=bench.timeout)
    scenes = _read_scenes(bench)
    header = _header(bench, setup, scenes)
    latencies, done = _earlier(file, header) if resume else ({}, {})
    _refuse_to_lose(file, resume)
    grid = cells(
        scenes, bench.goals, bench.methods, range(bench.seed, bench.seed + bench.targets), range(bench.repeats)
    )
    _refuse_to_drop(file, grid, done)
    # A scene that cannot be made is known before hours are spent on the others.
    for name, target in dict.fromkeys((cell.scene, cell.target) for cell in grid if cell not in done):
        concrete_scene(scenes[name], target)
    with _terminated_like_interrupted():
        todo = [cell for cell in grid if cell not in done]
        if todo:
            with _crew(bench) as crew:
                _add_latencies(crew, bench, scenes, setup, todo, latencies)
                header["latencies"] = latencies
                journal = None if file is None else Journal(journal_of(file))
                if journal is not None:
                    journal.start(header, list(done.values()))
                tasks = [
                    EpisodeTask(cell, scenes[cell.scene], latencies[cell.scene][cell.method]["latency_s"], setup)
                    for cell in todo
                ]
                _run(crew, tasks, done, journal)
    report = {**header, "latencies": latencies, "episodes": [done[cell] for cell in grid]}
    if file is not None:
        write_whole(file, json.dumps(report, indent=1, allow_nan=False) + "\n")
        journal_of(file).unlink(missing_ok=True)
    show(report, results)
    return report


def report_table1(file: Path, results: Path | None, other: Path | None = None) -> Report:
    """Print the table of a finished run and write the page of results, from its JSON alone.

    `other`: the JSON of a run with other goals, to say on the page which condition decides.

    Raises
    ------
    SettingsError
        If there is no such file, it is not that of a finished run, or the two were run with different settings.
    """
    report = _read_report(file)
    second = None if other is None else _read_report(other)
    if second is not None:
        _check_same(report["settings"], second["settings"], str(file))
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
    """All that is known of the run before it; the same after a way through JSON."""
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
    """The command line of a run, without what does not change its results and where they go."""
    words = ["contact-reach", "bench", "table1"]
    standard = Table1()
    for name in ("scenes", "goals", "methods"):
        if getattr(bench, name) != getattr(standard, name):
            words += [f"--{name}", *(Path(value).name for value in getattr(bench, name))]
    for name in ("targets", "repeats", "seed", "timeout", "latency"):
        if getattr(bench, name) != getattr(standard, name):
            words += [f"--{name}", f"{getattr(bench, name):g}"]
    return shlex.join(words)


def _refuse_to_lose(file: Path | None, resume: bool) -> None:
    if file is not None and not resume and journal_of(file).exists():
        raise SettingsError(
            f"{journal_of(file)} holds the episodes of a run that was interrupted: go on with it by --resume, or "
            "remove the file"
        )


def _refuse_to_drop(file: Path | None, grid: Sequence[Cell], done: dict[Cell, Record]) -> None:
    outside = sorted(set(done) - set(grid), key=dataclasses.astuple)
    if outside:
        raise SettingsError(
            f"{file}: holds {len(outside)} episodes that these options leave out, such as {outside[0]}: go on with the "
            "options of that run or with more, or begin another file"
        )


def _earlier(file: Path | None, header: Report) -> tuple[dict[str, Any], dict[Cell, Record]]:
    """Latencies and episodes of an unfinished or finished run with the same settings; none if there is none."""
    assert file is not None
    journal = journal_of(file)
    if journal.exists():
        earlier, records = read_journal(journal)
        source = journal
    elif file.exists():
        earlier = _read_report(file)
        records, source = earlier["episodes"], file
    else:
        return {}, {}
    _check_same(earlier["settings"], header["settings"], str(source))
    header["machine"] = earlier["machine"]
    return earlier["latencies"], {cell_of(record): record for record in records}


def _check_same(earlier: Any, now: Any, where: str) -> None:
    """Raise `SettingsError` where a setting that both runs have differs."""
    if isinstance(earlier, dict) and isinstance(now, dict):
        for key in earlier.keys() & now.keys():
            _check_same(earlier[key], now[key], f"{where}: {key}")
    elif earlier != now:
        raise SettingsError(
            f"{where} was {earlier!r} and is {now!r} now: a run can only go on with the settings it began with; set it "
            "back, or begin another file"
        )


def _read_report(file: Path) -> Report:
    try:
        report = json.loads(file.read_text())
    except OSError as error:
        raise SettingsError(
            f"{file}: cannot be read ({error.strerror}); expected the JSON of a finished run"
        ) from error
    except ValueError as error:
        raise SettingsError(f"{file}: not JSON ({error}); expected that of a finished run") from error
    if not isinstance(report, dict) or report.get("bench") != "table1":
        raise SettingsError(f"{file}: is not a result of bench table1")
    return report


def _crew(bench: Table1) -> Crew:
    if bench.scheduler is not None:
        return DaskCrew(bench.scheduler)
    return ProcessCrew(bench.workers or os.cpu_count() or 1)


def _add_latencies(
    crew: Crew,
    bench: Table1,
    scenes: dict[str, SceneFile],
    setup: Setup,
    todo: Sequence[Cell],
    latencies: dict[str, Any],
) -> None:
    """Find the latencies that the cells need, one after the other on workers that have nothing else to do."""
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
    for task in tasks:
        # One at a time: `run_all` would keep all workers busy.
        ((_, found),) = run_all(crew, measure_latency, [task])
        if isinstance(found, BaseException):
            raise SettingsError(f"the time of a plan of {task.method} in {task.scene.name} cannot be measured: {found}")
        latencies[task.scene.name][task.method] = found
        _say(f"{task.scene.name}, {task.method}: a plan takes {1e3 * found['latency_s']:.0f} ms")


def _run(crew: Crew, tasks: list[EpisodeTask], done: dict[Cell, Record], journal: Journal | None) -> None:
    total = len(done) + len(tasks)
    try:
        with _progress(len(done), total) as advance:
            for task, found in run_all(crew, run_cell, by_program(tasks)):
                record = failed(task.cell, reason(found)) if isinstance(found, BaseException) else found
                done[task.cell] = record
                if journal is not None:
                    journal.append(record)
                advance(_line(record))
    except BaseException:
        if journal is not None:
            _say(f"interrupted: {len(done)} of {total} episodes are in {journal.file}; --resume goes on with them")
        raise


def _line(record: Record) -> str:
    cell = cell_of(record)
    start = f"{cell.scene}, {cell.goal}, {cell.method}, target {cell.target}, repeat {cell.repeat}:"
    if record["reached"]:
        return f"{start} {record['time']:.2f} s, {record['max_contact_force']:.2f} N"
    return f"{start} not reached, {record['stop_reason'] or record['failure'] or 'out of time'}"


@contextmanager
def _progress(done: int, total: int) -> Iterator[Callable[[str], None]]:
    """A bar on a terminal, else a line per episode; both on the error output, which leaves the table alone."""
    console = Console(stderr=True)
    if not console.is_terminal:

        def say(line: str) -> None:
            nonlocal done
            done += 1
            _say(f"{done}/{total} {line}")

        yield say
        return
    columns = (
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("", total=total, completed=done)
        yield lambda line: progress.update(bar, advance=1, description=line)


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM, too, unwind the stack, so that the workers are ended."""

    def end(number: int, frame: FrameType | None) -> None:
        sys.exit(_TERMINATED)

    try:
        before = signal.signal(signal.SIGTERM, end)
    except ValueError:
        # Not in the main thread, where signals are somebody else's affair.
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
