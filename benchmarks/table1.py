"""The paper's Table I: every method in every scene, compared with the paper and with our own requirements."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.baselines.methods import METHODS
from benchmarks.claims import Results, claims
from benchmarks.grid import GOALS, Cell, Setup
from benchmarks.grid_run import run_grid
from benchmarks.output import Report, command_line, command_of, given, run_command, write_report
from benchmarks.table1_report import tables
from contact_reach_ros.arm.kinematics import TASK_ROWS
from contact_reach_ros.arms import DEFAULT_ARM
from contact_reach_ros.control.settings import AUTO
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.scene_file import SceneFile, read_scene

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
        What law (1) controls: one of `TASK_ROWS`, or as much as the arm can hold.
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
    task: str = AUTO

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
        """All episodes, target by target."""
        targets = range(self.seed, self.seed + self.targets)
        every = itertools.product(targets, range(self.repeats), self.scene_files, self.goals, self.methods)
        return [Cell(scene, goal, method, target, repeat) for target, repeat, scene, goal, method in every]


def bench_table1(
    bench: Table1, file: Path | None = None, workers: int | None = None, setup: Setup | None = None
) -> Report:
    """Run the episodes on `workers` processes, print tables and claims in Markdown, and write JSON to `file`.

    Raises
    ------
    SettingsError
        If the preset is unknown.
    SceneError
        If a scene cannot be made.
    """
    changes: dict[str, Any] = {} if bench.timeout is None else {"timeout": bench.timeout}
    setup = setup or Setup.of(bench.preset, load_budget(), bench.arm, bench.task, **changes)
    scenes = bench.scene_files
    description = {
        "command": command_of("table1", bench),
        "grid": {
            "scenes": list(scenes),
            "goals": list(bench.goals),
            "methods": list(bench.methods),
            "targets": bench.targets,
            "repeats": bench.repeats,
            "seed": bench.seed,
        },
    }
    report = run_grid("table1", description, setup, scenes, bench.cells, workers, bench.latency)
    report["claims"] = claims(Results(report["episodes"]), list(scenes), bench.goals)
    write_report(report, file)
    print(tables(report))
    return report


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--preset", help="configuration: paper_linear, paper_hinge or shipped (default: shipped)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: the paper's)")
    parser.add_argument("--goals", nargs="+", metavar="GOAL", help="hold the orientation, or free (default: both)")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="see benchmarks/baselines.md (default: four)")
    parser.add_argument("--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)")
    parser.add_argument("--task", choices=TASK_ROWS, help="what law (1) controls (default: what the arm can hold)")
    parser.add_argument("--targets", type=int, help="targets per scene (default: 70)")
    parser.add_argument("--repeats", type=int, help="episodes per target (default: 1)")
    parser.add_argument("--seed", type=int, help="of the first target (default: 0)")
    parser.add_argument("--timeout", type=float, help="simulated time to reach a goal, s (default: 20, or 60)")
    parser.add_argument("--latency", type=float, metavar="SECONDS", help="time of a plan (default: the preset's)")
    options = given(parser, arguments)
    file, workers = options.pop("file", None), options.pop("workers", None)
    bench_table1(Table1(**options), file, workers)


if __name__ == "__main__":
    run_command(main)
