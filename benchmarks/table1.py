"""`contact-reach bench table1`: the paper's Table I, compared with the paper and with our own requirements."""

from __future__ import annotations

import itertools
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from contact_reach_ros.arms import DEFAULT_ARM
from contact_reach_ros.errors import SettingsError
from benchmarks.baselines.methods import METHODS
from benchmarks.claims import Results, claims
from benchmarks.grid import GOALS, Cell, Setup
from benchmarks.grid_run import Running, finish, run_grid
from benchmarks.output import Report, read_report
from benchmarks.table1_report import tables
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.scene import SceneFile

SCENES = ("free", "ball", "wall", "ball_mismatch", "wall_mismatch", "ball_misplaced", "wall_misplaced")
"""In the order of the paper's table, with those that differ from the models last."""


@dataclass(frozen=True)
class Table1:
    """What is run.

    Attributes
    ----------
    preset
        Name of the configuration, see `presets`.
    scenes
        Names or YAML files.
    goals, methods
        Some of `GOALS` and `METHODS`.
    targets, repeats
        Targets per scene, with the seeds `seed`, `seed` + 1, ..., and repeats of each with other random numbers. A
        method that never fails shows `paper.SUCCESS` with 70.
    timeout
        Time to reach the goal, simulated, s; None for 20 s, or 60 s with plans that take as long as the paper's.
    latency
        Latency of all plans, s; that of the preset if None.
    arm
        Name of an arm, or path of its file.
    task
        What law (1) controls: one of `TASK_ROWS`.
    """

    preset: str = "shipped"
    scenes: tuple[str, ...] = SCENES
    goals: tuple[str, ...] = GOALS
    methods: tuple[str, ...] = ("contact_reach", "reference_posture", "collision_free", "rrt_star")
    targets: int = 70
    repeats: int = 1
    seed: int = 0
    timeout: float | None = None
    latency: float | None = None
    arm: str = DEFAULT_ARM
    task: str = "pose"

    def __post_init__(self) -> None:
        for name, values, known in (("goals", self.goals, GOALS), ("methods", self.methods, tuple(METHODS))):
            for value in values:
                if value not in known:
                    raise SettingsError(f"--{name} '{value}' is unknown; expected one of {', '.join(known)}")
        for name, number, least in (("targets", self.targets, 1), ("repeats", self.repeats, 1), ("seed", self.seed, 0)):
            if number < least:
                raise SettingsError(f"--{name} {number}: expected at least {least}")
        if self.timeout is not None and not self.timeout > 0.0:
            raise SettingsError(f"--timeout {self.timeout:g}: expected a positive time in s")
        if self.latency is not None and not 0.001 <= self.latency <= 1.0:
            raise SettingsError(f"--latency {self.latency:g}: expected 0.001 to 1 s")

    @property
    def scene_files(self) -> dict[str, SceneFile]:
        """Scenes by the names of their files; raises `SettingsError` if two files have one."""
        scenes: dict[str, SceneFile] = {}
        for name in self.scenes:
            scene = read_scene(name)
            if scene.name in scenes and scenes[scene.name] != scene:
                raise SettingsError(f"--scenes: two files are named '{scene.name}'; rename one of them")
            scenes[scene.name] = scene
        return scenes

    @property
    def cells(self) -> list[Cell]:
        """All episodes, target by target, so that an unfinished run compares methods on the same targets."""
        targets = range(self.seed, self.seed + self.targets)
        every = itertools.product(targets, range(self.repeats), self.scene_files, self.goals, self.methods)
        return [Cell(scene, goal, method, target, repeat) for target, repeat, scene, goal, method in every]

    @property
    def command(self) -> str:
        """The command line of the run, without options that do not change its results."""
        words = ["contact-reach", "bench", "table1", "--preset", self.preset]
        for name in ("scenes", "goals", "methods"):
            if getattr(self, name) != getattr(Table1, name):
                words += [f"--{name}", *(Path(value).name for value in getattr(self, name))]
        for name in ("arm", "task", "targets", "repeats", "seed", "timeout", "latency"):
            value = getattr(self, name)
            if value != getattr(Table1, name):
                words += [f"--{name}", value if isinstance(value, str) else f"{value:g}"]
        return shlex.join(words)

    def evaluate(self, report: Report) -> None:
        """Add the claims to a report with episodes."""
        report["claims"] = claims(Results(report["episodes"]), list(self.scene_files), self.goals)


def bench_table1(bench: Table1, running: Running, setup: Setup | None = None) -> Report:
    """Run the episodes, print tables and claims in Markdown, and write JSON.

    Raises
    ------
    SettingsError
        If the preset is unknown, or the run to be resumed has other settings.
    SceneError
        If a scene cannot be made.
    """
    changes: dict[str, Any] = {} if bench.timeout is None else {"timeout": bench.timeout}
    setup = setup or Setup.of(bench.preset, load_budget(), bench.arm, bench.task, **changes)
    scenes = bench.scene_files
    description = {
        "command": bench.command,
        "grid": {
            "scenes": list(scenes),
            "goals": list(bench.goals),
            "methods": list(bench.methods),
            "targets": bench.targets,
            "repeats": bench.repeats,
            "seed": bench.seed,
        },
    }
    report = run_grid("table1", description, setup, scenes, bench.cells, running, bench.latency)
    bench.evaluate(report)
    finish(report, running.file)
    print(tables(report))
    return report


def report_table1(file: Path) -> Report:
    """Print tables and claims of a finished run, from its JSON alone.

    Raises
    ------
    SettingsError
        If there is no such file, or it holds no finished run.
    """
    report = read_report(file, "table1")
    print(tables(report))
    return report
