"""Time and steps of plans in closed loops, and what planning joint torques takes instead (Section V-B).

Both methods run the same episodes, with plans of the same latency and without a deadline, so that each plan ends by its
own stop rule. Times hold for this machine, with one process that nobody disturbs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import paper
from benchmarks.grid import Cell, EpisodeTask, Record, Setup, run_cell
from benchmarks.output import Report, command_line, given, machine, run_command, say, table, write_report
from benchmarks.workers import run_each
from contact_reach_ros.arms import DEFAULT_ARM
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.scene import NO_MISMATCH
from contact_reach_ros.world.scene_file import read_scene, scene_names

METHODS = (paper.METHOD, paper.JOINT_TORQUE)
_CLOSED_LOOP_S, _LATENCY_S = 4.0, 0.1
"""Length of the runs, and time of each plan there, s."""


@dataclass(frozen=True)
class PlannerBench:
    """What is run.

    Attributes
    ----------
    scenes
        Names or YAML files; those of the package whose robot is as modelled if there are none.
    targets, seed
        Number of seeds of each scene, and the first.
    arm
        Name of an arm, or path of its file.
    settings
        The planner's.

    Raises
    ------
    SettingsError
        If there is no target.
    """

    scenes: tuple[str, ...] = ()
    targets: int = 3
    seed: int = 0
    arm: str = DEFAULT_ARM
    settings: PlanningSettings = dataclasses.field(default_factory=lambda: PlanningSettings(deadline=0.0))

    def __post_init__(self) -> None:
        if self.targets < 1:
            raise SettingsError(f"--targets {self.targets}: expected at least 1")


def bench_planner(bench: PlannerBench, file: Path | None) -> Report:
    """Run, print a table in Markdown and write JSON to `file`."""
    setup = Setup(arm=bench.arm, planning=bench.settings, budget=load_budget(), timeout=_CLOSED_LOOP_S)
    scenes = [read_scene(name) for name in bench.scenes or scene_names()]
    if not bench.scenes:
        scenes = [scene for scene in scenes if scene.mismatch == NO_MISMATCH]
    seeds = range(bench.seed, bench.seed + bench.targets)
    tasks = [
        EpisodeTask(Cell(scene.name, "hold", method, seed), scene, _LATENCY_S, setup)
        for scene in scenes
        for method in METHODS
        for seed in seeds
    ]
    records: list[Record] = []
    # One process, with one thread for linear algebra: several, spinning, take ten times as long.
    for record in run_each(run_cell, tasks, 1):
        records.append(record)
        say(f"{len(records)} of {len(tasks)} episodes")
    report: Report = {"bench": "planner", "machine": machine(), "episodes": records, "scenes": {}}
    for scene in scenes:
        rows = {
            method: _times([each for each in records if (each["scene"], each["method"]) == (scene.name, method)])
            for method in METHODS
        }
        ratio = rows[paper.JOINT_TORQUE]["plan_ms"] / rows[paper.METHOD]["plan_ms"]
        report["scenes"][scene.name] = {**rows, "torque_planning_ratio": ratio}
    print(_table(report))
    write_report(report, file)
    return report


def _times(records: Sequence[Record]) -> Report:
    """Medians over the episodes of one method."""
    failures = [record["failure"] for record in records if record["timing"] is None or not record["plans"]]
    if failures:
        raise SettingsError(f"an episode has no plans: {failures[0]}")
    timing = [record["timing"] for record in records]
    steps = float(np.median([record["solver_steps"] / record["plans"] for record in records]))
    plan_ms = 1e3 * float(np.median([each["plan_s"] for each in timing]))
    return {
        "plans": sum(record["plans"] for record in records),
        "first_plan_ms": 1e3 * float(np.median([each["first_plan_s"] for each in timing])),
        "plan_ms": plan_ms,
        "steps": steps,
        "step_ms": plan_ms / steps,
    }


def _table(report: Report) -> str:
    rows = []
    for scene, found in report["scenes"].items():
        for method in METHODS:
            row = found[method]
            ratio = f"{found['torque_planning_ratio']:.2f}" if method == paper.JOINT_TORQUE else ""
            figures = [f"{row[key]:.1f}" for key in ("first_plan_ms", "plan_ms", "steps", "step_ms")]
            rows.append([scene, method, str(row["plans"]), *figures, ratio])
    published = paper.WALL_PLANNING_TIME
    for method in METHODS:
        ratio = f"{published[method] / published[paper.METHOD]:.2f}" if method == paper.JOINT_TORQUE else ""
        rows.append(["wall", f"paper: {method}", "", "", f"{1e3 * published[method]:.0f}", "", "", ratio])
    header = [
        "scene",
        "method",
        "plans",
        "first plan, ms",
        "plan, ms p50",
        "steps",
        "step, ms",
        "times the references'",
    ]
    return table(header, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free, ball, wall)")
    parser.add_argument("--targets", type=int, help="episodes per scene and method (default: 3)")
    parser.add_argument("--seed", type=int, help="of the first target (default: 0)")
    parser.add_argument("--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)")
    options = given(parser, arguments)
    file = options.pop("file", None)
    bench_planner(PlannerBench(**options), file)


if __name__ == "__main__":
    run_command(main)
