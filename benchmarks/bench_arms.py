"""The table of arms of docs/results.md: every arm of the package among balls and, if it has a redundancy, walls."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from contact_reach_ros.arms import ARMS, load_arm
from contact_reach_ros.control.settings import POSE, POSITION, TASK_ROWS
from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.bench_table1 import Table1, bench_table1
from contact_reach_ros.experiments.grid_run import Running, partial_of
from contact_reach_ros.experiments.output import Report, read_report, say, table

if TYPE_CHECKING:
    from distributed import Client

ARMS_PART = "arms"
"""Name of the part, and of its folder."""
_TARGETS = 10
_EPISODE_S, _PROGRAM_S = 8.0, 25.0
"""Processor's time that an episode was found to take, on average, and making a planner's programs, s."""


def arm_benches(quick: bool = False) -> dict[str, Table1]:
    """The runs by name, one for each arm, scene and task.

    Arms that are not redundant for a pose have no posture to pull to then, and no way around the walls: they are run
    with the position alone, too.
    """
    benches = {}
    for arm in ARMS[:1] if quick else ARMS:
        is_redundant = load_arm(arm).n > TASK_ROWS[POSE]
        for task in (POSE,) if is_redundant else (POSE, POSITION):
            for scene in ("free", "ball", "wall") if is_redundant else ("free", "ball"):
                posture = (paper.REFERENCE_POSTURE,) if is_redundant else ()
                others = () if scene == "free" else (*posture, paper.COLLISION_FREE)
                benches[f"{arm}_{scene}_{task}"] = Table1(
                    scenes=(scene,),
                    goals=("hold",),
                    methods=(paper.METHOD, *others),
                    targets=1 if quick else _TARGETS,
                    arm=arm,
                    task=task,
                )
    return benches


def bench_arms(out: Path, quick: bool = False, client: Client | None = None) -> None:
    """Run what is not in the folder `out` yet."""
    for name, bench in arm_benches(quick).items():
        if len(_episodes(out, name)) < len(bench.cells):
            say(f"{name}: {bench.command}")
            bench_table1(bench, Running(out / f"{name}.json", resume=True, client=client))


def arm_episodes(out: Path, quick: bool) -> tuple[int, int, float]:
    """Number of episodes in all, of those that are missing in the folder, and the processor's time they take, s."""
    whole = left = programs = 0
    for name, bench in arm_benches(quick).items():
        missing = len(bench.cells) - len(_episodes(out, name))
        whole, left = whole + len(bench.cells), left + missing
        programs += len(bench.methods) if missing else 0
    return whole, left, left * _EPISODE_S + programs * _PROGRAM_S


def arms_table(out: Path) -> str:
    """What there is in the folder: a row for each arm, scene, task and method; empty if there is nothing."""
    rows, missing = [], 0
    for name, bench in arm_benches().items():
        episodes = _episodes(out, name)
        missing += len(bench.cells) - len(episodes)
        for method in bench.methods:
            mine = [episode for episode in episodes if episode["method"] == method]
            if mine:
                rows.append([f"`{bench.arm}`", bench.task, *bench.scenes, method, *_figures(mine)])
    header = ["arm", "task", "scene", "method", "settled", "stopped", "time / limit", "force N", "plan ms"]
    note = f"**Not finished: {missing} episodes are missing.**\n\n" if missing else ""
    return note + table(header, rows) if rows else ""


def _figures(episodes: list[Report]) -> list[str]:
    """Of one method: how many settled and were stopped; means and largest values."""
    ratios = [episode["time_ratio"] for episode in episodes if episode["reached"]]
    forces = [episode["max_contact_force"] for episode in episodes]
    plans = [episode["timing"]["plan_s"] for episode in episodes if episode["timing"] and episode["timing"]["plan_s"]]
    return [
        f"{len(ratios)}/{len(episodes)}",
        str(sum(bool(episode["stop_reason"]) for episode in episodes)),
        f"{np.mean(ratios):.2f} ({max(ratios):.2f})" if ratios else "–",
        f"{np.mean(forces):.2f} ({max(forces):.2f})",
        f"{1e3 * np.median(plans):.0f}" if plans else "–",
    ]


def _episodes(out: Path, name: str) -> list[Report]:
    """The episodes of a run, finished or not."""
    file = out / f"{name}.json"
    source = next((path for path in (partial_of(file), file) if path.exists()), None)
    return read_report(source, "table1")["episodes"] if source else []
