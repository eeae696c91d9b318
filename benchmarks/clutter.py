"""Every method in random scenes with several soft bodies."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import paper
from benchmarks.baselines.methods import METHODS
from benchmarks.claims import interval_text
from benchmarks.clutter_scenes import FIRST_HELD_OUT, clutter_name, clutter_scene
from benchmarks.grid import Cell, Record, Setup
from benchmarks.grid_run import run_grid
from benchmarks.oracle import Kind, seeds_of, sorted_out
from benchmarks.output import Report, command_line, command_of, given, run_command, table, write_report
from benchmarks.statistics import Estimate, estimate, share
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.world.scene import NO_MISMATCH, MismatchSettings
from contact_reach_ros.world.spheres import MAX_SPHERES

_EQUAL = 0.1
"""Peak forces that differ by less count as equal, N; the faster method is then the better one."""

_FIGURES = (
    # key of the JSON, heading, figure of the records
    ("time_ratio", "time / limit", "time_ratio"),
    ("peak_force_N", "peak force, N", "max_contact_force"),
    ("mean_force_N", "mean force, N", "mean_contact_force"),
    ("impulse_Ns", "impulse, N s", "contact_impulse"),
)


@dataclass(frozen=True)
class Clutter:
    """What is run: a number of scenes with the seeds from `seed` on, or those of `only`; for the rest see `Table1`.

    Of the scenes from `seed` on, those of `kind` count, if it is one of the oracle's.
    """

    preset: str = "shipped"
    scenes: int = 100
    seed: int = FIRST_HELD_OUT
    kind: str = ""
    oracle: Path | None = None
    """File in which the oracle's kinds are looked up; by default scenes are looked at again."""
    only: tuple[int, ...] = ()
    methods: tuple[str, ...] = (
        "contact_reach",
        "no_detours",
        "reference_posture",
        "collision_free",
        "rrt_star",
        "cma_es",
        "contact_rrt",
        "reactive",
    )
    timeout: float = 60.0
    """To reach the goal, s; methods that follow a path to its end have longer."""
    foam_factor: float = 1.0
    """Up to how much stiffer or softer bodies are than they are said to be."""
    placement_error: float = 0.0
    """Up to how far they are from where they are seen, m."""

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in METHODS:
                raise SettingsError(f"--methods '{method}' is unknown; expected one of {', '.join(METHODS)}")
        for name, number, least in (
            ("scenes", self.scenes, 1),
            ("seed", self.seed, 0),
            *(("only", each, 0) for each in self.only),
        ):
            if number < least:
                raise SettingsError(f"--{name} {number}: expected at least {least}")
        if self.kind and self.only:
            raise SettingsError("--kind and --only both choose the scenes; expected one of them")
        if self.oracle and not self.kind:
            raise SettingsError(f"--oracle {self.oracle} has kinds; expected a --kind, too")
        if not self.timeout > 0.0:
            raise SettingsError(f"--timeout {self.timeout:g}: expected a positive time in s")

    @functools.cached_property
    def seeds(self) -> Sequence[int]:
        """Of the scenes."""
        if self.kind and self.oracle:
            return sorted_out(self.oracle, self.kind, self.scenes)
        if self.kind:
            return seeds_of(self.kind, self.seed, self.scenes)
        return self.only or range(self.seed, self.seed + self.scenes)

    @property
    def mismatch(self) -> MismatchSettings:
        """Of the simulation; the robot itself is as it is modelled."""
        return dataclasses.replace(NO_MISMATCH, foam_factor=self.foam_factor, placement_error=self.placement_error)

    @property
    def cells(self) -> list[Cell]:
        """All episodes, scene by scene."""
        return [Cell(clutter_name(seed), "hold", method, seed) for seed in self.seeds for method in self.methods]


def bench_clutter(
    bench: Clutter, file: Path | None = None, workers: int | None = None, setup: Setup | None = None
) -> Report:
    """Run the episodes on `workers` processes, print the table in Markdown, and write JSON to `file`.

    Raises
    ------
    SettingsError
        If the preset is unknown.
    """
    setup = setup or Setup.of(bench.preset, load_budget(), capacity=MAX_SPHERES, timeout=bench.timeout)
    arm = load_arm(setup.arm)
    files = (clutter_scene(arm, seed) for seed in bench.seeds)
    scenes = {file.name: dataclasses.replace(file, mismatch=bench.mismatch) for file in files}
    description = {"command": command_of("clutter", bench), "seeds": [bench.seeds[0], bench.seeds[-1]]}
    report = run_grid("clutter", description, setup, scenes, bench.cells, workers)
    report.update(summary(report["episodes"], bench.methods))
    write_report(report, file)
    print(clutter_table(report))
    return report


def summary(episodes: Sequence[Record], methods: Sequence[str]) -> dict[str, Any]:
    """What the report says of each method, each with mean and interval over scenes.

    Forces are those of all episodes, so that a method that does not move presses least; `against` has the differences
    from the method, another's less its own, in the scenes where both settle, and that of settling in all of them.
    """
    by_method: dict[str, dict[str, Record]] = {method: {} for method in methods}
    for entry in episodes:
        by_method[entry["method"]][entry["scene"]] = entry
    scenes = list(by_method[methods[0]])
    best = Counter(_best([by_method[method][scene] for method in methods]) for scene in scenes)
    own = by_method.get(paper.METHOD, {})
    made: dict[str, Any] = {}
    for method, records in by_method.items():
        entries = list(records.values())
        entered = sum(entry["entry_time"] is not None and not entry["stop_reason"] for entry in entries)
        made[method] = {
            "entered": share(entered, len(entries)).json,
            "settled": share(sum(entry["reached"] for entry in entries), len(entries)).json,
            "success": share(sum(entry["success"] for entry in entries), len(entries)).json,
            **{key: _over(entries, figure).json for key, _, figure in _FIGURES},
            "best": share(best[method], len(scenes)).json,
            "against": {
                "settled": estimate([float(records[name]["reached"]) - own[name]["reached"] for name in own]).json,
                **{key: _against(own, records, figure).json for key, _, figure in (*_FIGURES, ("time_s", "", "time"))},
            },
        }
    free = by_method.get(paper.COLLISION_FREE)
    needed = None
    if free is not None and own:
        needed = share(sum(own[name]["reached"] and not free[name]["reached"] for name in scenes), len(scenes)).json
    return {"methods": made, "contact_needed": needed, "scenes": len(scenes)}


def _over(entries: Sequence[Record], figure: str) -> Estimate:
    return estimate([entry[figure] for entry in entries if entry[figure] is not None])


def _against(own: dict[str, Record], records: dict[str, Record], figure: str) -> Estimate:
    """A figure less the method's, in scenes where both settle."""
    both = [name for name in own if own[name]["reached"] and records[name]["reached"]]
    return estimate([records[name][figure] - own[name][figure] for name in both])


def _best(entries: Sequence[Record]) -> str:
    """Of those that settle, the method that presses least, and of equals the fastest; empty if none settles."""
    settled = [entry for entry in entries if entry["reached"]]
    if not settled:
        return ""
    least = min(entry["max_contact_force"] for entry in settled)
    equal = [entry for entry in settled if entry["max_contact_force"] <= least + _EQUAL]
    return str(min(equal, key=lambda entry: entry["time"])["method"])


def clutter_table(report: Report) -> str:
    """The report's table, and how often contact is what makes the goal reachable."""
    headings = ["method", "first there", "settled", "settled within ε", *(heading for _, heading, _ in _FIGURES)]
    headings += ["best", "settled less the method's", "peak force less the method's, N", "time less the method's, s"]
    rows = []
    for method, found in report["methods"].items():
        own = method == paper.METHOD
        cells = [f"**{method}**" if own else method]
        cells += [_percent(found[key]) for key in ("entered", "settled", "success")]
        cells += [_text(found[key]) for key, *_ in _FIGURES]
        cells.append(_percent(found["best"]))
        against = found["against"]
        cells.append("" if own else _percent(against["settled"]))
        cells += ["" if own else _text(against[key]) for key in ("peak_force_N", "time_s")]
        rows.append(cells)
    lines = [f"`{report['command']}`: {report['scenes']} scenes.", "", table(headings, rows)]
    if report["contact_needed"] is not None:
        lines += [
            "",
            f"Collision-free planning fails and contact gets the arm there in {_percent(report['contact_needed'])} of "
            "the scenes.",
        ]
    return "\n".join(lines)


def _text(found: dict[str, Any]) -> str:
    return "–" if found["mean"] is None else interval_text(found["mean"], found["ci95"])


def _percent(found: dict[str, Any]) -> str:
    mean, (low, high) = found["mean"], found["ci95"]
    if mean is None or math.isnan(mean):
        return "–"
    interval = "" if low is None else f" [{100 * low:.0f}, {100 * high:.0f}]"
    return f"{100 * mean:.0f} %{interval}"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument("--preset", help="configuration: paper_linear, paper_hinge or shipped (default: shipped)")
    parser.add_argument("--scenes", type=int, help="how many (default: 100)")
    parser.add_argument("--seed", type=int, help="of the first; below 10000 for tuning (default: 10000)")
    kinds = [kind.value for kind in Kind]
    parser.add_argument("--kind", choices=kinds, help="only those that the oracle says are of this kind (default: all)")
    parser.add_argument(
        "--oracle", type=Path, metavar="FILE", help="what benchmarks.oracle --json wrote of these scenes"
    )
    parser.add_argument("--only", nargs="+", type=int, metavar="SEED", help="scenes with these seeds instead")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="see benchmarks/baselines.md (default: eight)")
    parser.add_argument("--timeout", type=float, help="simulated time to reach a goal, s (default: 60)")
    parser.add_argument("--foam-factor", type=float, help="bodies are up to so much stiffer or softer than said")
    parser.add_argument("--placement-error", type=float, help="bodies are up to so far from where they are seen, m")
    options = given(parser, arguments)
    file, workers = options.pop("file", None), options.pop("workers", None)
    bench_clutter(Clutter(**options), file, workers)


if __name__ == "__main__":
    run_command(main)
