"""`contact-reach bench page`: everything that docs/results.md shows, in one run that can be interrupted."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.baselines.methods import PLANLESS
from contact_reach_ros.experiments.bench_arms import ARMS_PART, arm_episodes, arms_table, bench_arms
from contact_reach_ros.experiments.bench_clutter import Clutter, bench_clutter, clutter_table
from contact_reach_ros.experiments.bench_fig5 import Fig5, bench_fig5
from contact_reach_ros.experiments.bench_floor import bench_floor, floor_table
from contact_reach_ros.experiments.bench_setting import Sweep, bench_setting, setting_table
from contact_reach_ros.experiments.bench_table1 import Table1, bench_table1
from contact_reach_ros.experiments.grid_run import Running, partial_of
from contact_reach_ros.experiments.output import Report, read_report, say, table, write_report, write_whole
from contact_reach_ros.experiments.pictures import plot_clutter, plot_setting, plot_table1
from contact_reach_ros.experiments.statistics import least_difference, least_share
from contact_reach_ros.experiments.table1_report import tables
from contact_reach_ros.experiments.workers import workers as make_workers

Bench = Table1 | Clutter | Sweep

_THREE = ("free", "ball", "wall")
_PAIR = (paper.METHOD, paper.REFERENCE_POSTURE)
_WITH_PATH = (*_PAIR, paper.COLLISION_FREE)
_FIRST, _TUNING = 20, 100
"""Seeds of the first targets: of the tables, where nothing was tuned, and of the sweeps."""
_AS_IN_THE_NODE = ("max_steps=5",)
_WEIGHTS = (0.0, 0.003, 0.01, 0.05, 0.5, 5.0)


class Part(NamedTuple):
    """One grid of the page, with the processor's time that an episode was found to take, s, on average."""

    name: str
    bench: Bench
    seconds: float
    claims: int = 0
    """How many are made of it together, for the power that `--dry-run` states."""
    is_in_quick: bool = True
    """Whether `--quick` has it, which leaves out what runs nothing that other parts do not."""


PARTS = (
    Part("clutter", Clutter(), 10.0),
    Part("tuning", Clutter(seed=0), 10.0, is_in_quick=False),
    Part("clutter_hinge", Clutter("paper_hinge", scenes=20, seed=0, methods=_PAIR), 25.0),
    Part("clutter_linear", Clutter("paper_linear", scenes=20, seed=0, methods=_PAIR), 25.0),
    Part("shipped", Table1(scenes=_THREE, goals=("hold",), targets=60, seed=_FIRST), 3.0, 12),
    Part("hinge", Table1("paper_hinge", _THREE, ("hold",), _WITH_PATH, targets=20, seed=_FIRST), 9.0, 12),
    Part("linear", Table1("paper_linear", _THREE, ("hold",), _WITH_PATH, targets=20, seed=_FIRST), 12.0, 12),
    Part(
        "mismatch",
        Table1(scenes=paper.TORQUE_SCENES, goals=("hold",), methods=_WITH_PATH, targets=30, seed=_FIRST),
        8.0,
        8,
    ),
    Part(
        "position",
        Table1(scenes=("ball", "wall"), goals=("free",), methods=_WITH_PATH, targets=20, seed=_FIRST),
        6.0,
        10,
    ),
    *(
        Part(f"{name}_{reading}", Table1(f"paper_{reading}", scenes, (goal,), _PAIR, 10, seed=_FIRST), 12.0, 5, False)
        for name, scenes, goal in (("mismatch", paper.TORQUE_SCENES, "hold"), ("position", ("ball", "wall"), "free"))
        for reading in ("hinge", "linear")
    ),
    Part(
        "own_weight",
        Sweep("contact_weight", (0.003, 0.01), ("wall", "ball"), _PAIR, 20, _FIRST, others=_AS_IN_THE_NODE),
        6.0,
        is_in_quick=False,
    ),
    Part(
        "weights",
        Sweep(
            "contact_weight",
            _WEIGHTS,
            scenes=("wall", "ball"),
            methods=(*_PAIR, "cma_es"),
            targets=5,
            seed=_TUNING,
            others=_AS_IN_THE_NODE,
        ),
        6.0,
    ),
    Part(
        "gains",
        Sweep(
            "null_stiffness",
            (10.0, 30.0, 90.0),
            scenes=("wall", "ball"),
            methods=_PAIR,
            targets=5,
            seed=_TUNING,
            others=_AS_IN_THE_NODE,
        ),
        5.0,
    ),
    Part(
        "nodes",
        Sweep("contact_weight", (0.01,), ("wall",), targets=5, seed=_TUNING, others=_AS_IN_THE_NODE, spheres=40),
        50.0,
    ),
)
"""Tables and sweeps of the page, which take most of its time."""

FLOOR, FIG5 = "floor", "fig5"
_FLOOR_TARGETS, _FLOOR_S, _FIG5_S, _PROGRAM_S = 10, 25.0, 40.0, 20.0
"""Targets of `bench floor`; processor's time of one, of the figure, and of making a planner's programs, s."""

_RUN: Mapping[type, Callable[..., Report]] = {Table1: bench_table1, Clutter: bench_clutter, Sweep: bench_setting}
_NAME = {Table1: "table1", Clutter: "clutter", Sweep: "setting"}
_TEXT: Mapping[type, Callable[[Report], str]] = {Table1: tables, Clutter: clutter_table, Sweep: setting_table}


def in_small(part: Part) -> Part:
    """The part with so few episodes that all of them take ten minutes."""
    bench: Any = part.bench
    if isinstance(bench, Clutter):
        methods = tuple(method for method in bench.methods if method in (*_WITH_PATH, "reactive"))
        scenes = 2 if bench.preset == "shipped" else 1
        return part._replace(bench=Clutter(bench.preset, scenes, seed=0, methods=methods))
    changes: dict[str, Any] = {"targets": 1}
    if isinstance(bench, Sweep):
        changes.update(scenes=("wall",), methods=bench.methods[:1], values=bench.values[::2], spheres=None)
    elif part.name != "shipped":
        changes.update(scenes=bench.scenes[-1:], methods=bench.methods[:2])
    return part._replace(bench=dataclasses.replace(bench, **changes))


def bench_page(
    out: Path,
    parts: Sequence[str] = (),
    quick: bool = False,
    dry_run: bool = False,
    report_only: bool = False,
    write: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    file: Path | None = None,
) -> dict[str, Any]:
    """Run what is not in the folder `out` yet, print all tables, and draw the figures.

    Parameters
    ----------
    out
        Folder with a JSON file for each part, and the figures.
    parts
        Names of some of `PARTS`, 'floor' or 'fig5'; all if empty.
    quick
        Everything in small.
    dry_run
        Only print how many episodes are left, what they take, and what their number can show.
    report_only
        Only report what is there, unfinished parts too.
    write
        A page whose tables are replaced; figures go beside it.

    Raises
    ------
    SettingsError
        If there is no such part, or what is in the folder has other settings.
    """
    known = [*(part.name for part in PARTS), ARMS_PART, FLOOR, FIG5]
    for name in parts:
        if name not in known:
            raise SettingsError(f"--parts '{name}' is unknown; expected some of {', '.join(known)}")
    wanted = parts or known
    chosen = [part for part in PARTS if part.name in wanted]
    if quick:
        chosen = [in_small(part) for part in chosen if part.is_in_quick]
    if dry_run:
        print(plan_table(chosen, out, wanted, quick))
        return {}
    if not report_only:
        out.mkdir(parents=True, exist_ok=True)
        targets = 1 if quick else _FLOOR_TARGETS
        with make_workers(workers, scheduler) as client:
            for part in chosen:
                say(f"{part.name}: {part.bench.command}")
                made = out / f"{part.name}.json"
                if not made.exists() or _left(part, out):
                    _RUN[type(part.bench)](part.bench, Running(made, resume=True, client=client))
            if ARMS_PART in wanted:
                bench_arms(out / ARMS_PART, quick, client)
            if FLOOR in wanted:
                bench_floor(targets=targets, seed=_FIRST, client=client, file=out / f"{FLOOR}.json")
        if FIG5 in wanted and not (out / "fig5.json").exists():
            bench_fig5(Fig5(latency=0.06), out / "fig5.png", out / "fig5.json")
    reports = {part.name: found for part in chosen if (found := _report(part, out)) is not None}
    blocks = {part.name: _block(part, reports[part.name]) for part in chosen if part.name in reports}
    if ARMS_PART in wanted and (text := arms_table(out / ARMS_PART)):
        blocks[ARMS_PART] = text
    if FLOOR in wanted and (out / f"{FLOOR}.json").exists():
        blocks[FLOOR] = floor_table(read_report(out / f"{FLOOR}.json", "floor"))
    _draw(reports, out if write is None else write.parent)
    for name, text in blocks.items() if report_only else ():
        print(f"\n## {name}\n\n{text}")
    write_report(reports, file)
    if write is not None:
        if FIG5 in wanted and (out / "fig5.png").exists():
            shutil.copy(out / "fig5.png", write.parent)
        write_whole(write, replaced(write.read_text(), blocks))
    return reports


def _report(part: Part, out: Path) -> Report | None:
    """What there is of a part, evaluated again; None if there is nothing."""
    source = next((path for path in (partial_of(_file(part, out)), _file(part, out)) if path.exists()), None)
    if source is None:
        return None
    report = read_report(source, _NAME[type(part.bench)])
    part.bench.evaluate(report)
    return report if report["episodes"] else None


def _file(part: Part, out: Path) -> Path:
    return out / f"{part.name}.json"


def _left(part: Part, out: Path) -> int:
    """Number of episodes that are missing."""
    found = _report(part, out)
    return len(part.bench.cells) - (len(found["episodes"]) if found else 0)


def _block(part: Part, report: Report) -> str:
    count, full = len(report["episodes"]), len(part.bench.cells)
    text = _TEXT[type(part.bench)](report)
    return text if count >= full else f"**Not finished: {count} of {full} episodes.**\n\n{text}"


def _draw(reports: Mapping[str, Report], folder: Path) -> None:
    """The figures that the reports are enough for."""
    for name in ("clutter", "tuning"):
        if name in reports and reports[name]["scenes"]:
            plot_clutter(reports[name], folder / "clutter.png")
            break
    presets = [reports[name] for name in ("shipped", "hinge", "linear") if name in reports]
    if presets:
        plot_table1(presets, folder / "table1.png")
    if "weights" in reports:
        plot_setting(reports["weights"], folder / "weights.png")


def replaced(page: str, blocks: Mapping[str, str]) -> str:
    """The page with the text between `<!-- NAME -->` and `<!-- /NAME -->` replaced for each block."""
    for name, text in blocks.items():
        begin, found, rest = page.partition(f"<!-- {name} -->\n")
        if found:
            _, end, after = rest.partition(f"<!-- /{name} -->")
            page = f"{begin}{found}\n{text}\n\n{end}{after}"
    return page


def plan_table(parts: Sequence[Part], out: Path, wanted: Sequence[str], is_quick: bool) -> str:
    """What is left to run, the time that it takes on two cores, and what the number of targets can show."""
    rows, total = [], 0.0
    for part in parts:
        found, left = _report(part, out), _left(part, out)
        seconds = left * _mean_seconds(found, part.seconds) + (_programs(part) * _PROGRAM_S if left else 0.0)
        total += seconds
        shows = "" if is_quick else _shows(part)
        rows.append([part.name, str(len(part.bench.cells)), str(left), f"{seconds / 7200:.2f}", shows])
    if ARMS_PART in wanted:
        whole, left, seconds = arm_episodes(out / ARMS_PART, is_quick)
        total += seconds
        rows.append([ARMS_PART, str(whole), str(left), f"{seconds / 7200:.2f}", ""])
    others = (
        (FLOOR, (1 if is_quick else _FLOOR_TARGETS) * _FLOOR_S, out / f"{FLOOR}.json"),
        (FIG5, _FIG5_S, out / "fig5.json"),
    )
    for name, seconds, file in others:
        if name in wanted:
            seconds = 0.0 if file.exists() else seconds
            total += seconds
            rows.append([name, "", "", f"{seconds / 7200:.2f}", ""])
    rows.append(["together", "", "", f"{total / 7200:.2f}", ""])
    return table(["part", "episodes", "left", "hours on two cores", "shows"], rows)


def _mean_seconds(report: Report | None, otherwise: float) -> float:
    """Processor's time of the episodes that there are, if they are enough to go by."""
    times = [entry["timing"]["cpu_s"] for entry in report["episodes"] if entry["timing"]] if report else []
    return sum(times) / len(times) if len(times) >= 20 else otherwise


def _programs(part: Part) -> int:
    """How many planners the part has to compile."""
    cells = part.bench.cells
    scenes = 1 if isinstance(part.bench, Clutter) else len({cell.scene for cell in cells})
    return scenes * len({(cell.variant, cell.method) for cell in cells if cell.method not in PLANLESS})


def _shows(part: Part) -> str:
    return "; ".join(_power(part))


def _power(part: Part) -> Iterator[str]:
    if isinstance(part.bench, Clutter):
        yield f"shares to ± {50 * least_difference(part.bench.scenes, 1, power=0.5):.0f} %"
    elif part.claims:
        targets = part.bench.targets
        yield f"{100 * least_share(targets, part.claims):.0f} % settle, if all do"
        yield f"differences of {least_difference(targets, part.claims):.2f} deviations"
