"""Whole episodes for each value of a setting of the planner or a gain."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.authors_cost import AuthorsSettings
from benchmarks.grid import Cell, Record, Setup
from benchmarks.grid_run import run_grid
from benchmarks.output import Report, command_line, command_of, given, run_command, table, write_report
from benchmarks.paper import METHOD
from contact_reach_ros.arms import DEFAULT_ARM
from contact_reach_ros.control.settings import ControllerSettings, ImpedanceSettings
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.planning.planner import ReplanningSettings
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.scene_file import read_scene

LATENCY = "latency"
"""Not a setting of the planner: time between plans and from a state to the effect of its plan, s."""

PERIOD = "period"
"""Nor is this: time from the beginning of a plan to that of the next, s."""

_GAINS = frozenset(field.name for field in dataclasses.fields(ImpedanceSettings))

_THEIRS = frozenset(AuthorsSettings.__annotations__)

_SLOWER = 1.1
"""The best value presses least among those that settle most often and are at most this much slower than the fastest."""


@dataclass(frozen=True)
class Sweep:
    """What is run.

    Attributes
    ----------
    name, values
        Of a field of `AuthorsSettings` or `ImpedanceSettings`, `LATENCY` or `PERIOD`, and what it takes.
    scenes, methods
        Names or YAML files, and some of `METHODS`.
    targets, seed
        Number of seeds of each scene, and the first.
    others
        Other settings, as in population=32; the same for each value.
    spheres
        Number of spheres that plans take into account; by default that of the scene.
    arm
        Name of an arm, or path of its file.

    Raises
    ------
    SettingsError
        If the setting is unknown or a value is out of range.
    """

    name: str
    values: tuple[Any, ...]
    scenes: tuple[str, ...] = ("ball", "wall")
    methods: tuple[str, ...] = (METHOD,)
    targets: int = 10
    seed: int = 0
    others: tuple[str, ...] = ()
    spheres: int | None = None
    arm: str = DEFAULT_ARM

    @property
    def variants(self) -> dict[str, Setup]:
        """The setup of each value, by its name."""
        common = _assignments(self.others)
        return {str(value): self._setup({**common, self.name: value}) for value in self.values}

    @property
    def cells(self) -> list[Cell]:
        """All episodes, target by target."""
        targets = range(self.seed, self.seed + self.targets)
        scenes = [read_scene(name).name for name in self.scenes]
        every = itertools.product(targets, scenes, self.methods, map(str, self.values))
        return [Cell(scene, "hold", method, target, 0, value) for target, scene, method, value in every]

    def _setup(self, values: Mapping[str, Any]) -> Setup:
        """Settings with these values, and without a deadline, so that results do not depend on the machine."""
        planning, replanning = {"deadline": 0.0, **values}, ReplanningSettings()
        if LATENCY in planning:
            # As in Table I, the next plan is begun when the last one is ready.
            latency = float(planning.pop(LATENCY))
            replanning = ReplanningSettings(period=latency, latency=latency)
        if PERIOD in planning:
            replanning = dataclasses.replace(replanning, period=float(planning.pop(PERIOD)))
        kind = AuthorsSettings if _THEIRS & planning.keys() else PlanningSettings
        gains = {name: planning.pop(name) for name in _GAINS & planning.keys()}
        return Setup(
            arm=self.arm,
            planning=kind.from_mapping(planning, "benchmarks.setting"),
            controller=ControllerSettings(impedance=ImpedanceSettings.from_mapping(gains, "benchmarks.setting")),
            budget=load_budget(),
            replanning=replanning,
            capacity=self.spheres,
        )


def bench_setting(sweep: Sweep, file: Path | None = None, workers: int | None = None) -> Report:
    """Run episodes on `workers` processes, print a table in Markdown and write JSON to `file`.

    Raises
    ------
    SettingsError
        As `Sweep`.
    """
    variants = sweep.variants
    scenes = {scene.name: scene for scene in map(read_scene, sweep.scenes)}
    description = {"command": command_of("setting", sweep), "setting": sweep.name, "targets": sweep.targets}
    setup = next(iter(variants.values()))
    report = run_grid("setting", description, setup, scenes, sweep.cells, workers, variants=variants)
    report["scenes"] = summary(report["episodes"], sweep.values)
    write_report(report, file)
    print(setting_table(report))
    return report


def summary(episodes: Sequence[Record], values: Sequence[Any]) -> dict[str, list[dict[str, Any]]]:
    """A row for each method and value that has episodes, by scene."""
    own: dict[tuple[str, str, str], list[Record]] = {}
    for entry in episodes:
        own.setdefault((entry["scene"], entry["method"], entry["variant"]), []).append(entry)
    rows: dict[str, list[dict[str, Any]]] = {}
    for scene, method in dict.fromkeys((scene, method) for scene, method, _ in own):
        for value in values:
            entries = own.get((scene, method, str(value)))
            if entries:
                rows.setdefault(scene, []).append({"method": method, "value": value, **_row(entries)})
    return rows


def _row(entries: Sequence[Record]) -> dict[str, Any]:
    def found(figure: str) -> dict[str, float]:
        values = [entry[figure] for entry in entries if entry[figure] is not None]
        if not values:
            return {"mean": float("nan"), "sd": float("nan")}
        return {"mean": float(np.mean(values)), "sd": float(np.std(values))}

    return {
        "targets": len(entries),
        "reached": sum(entry["reached"] for entry in entries),
        "time_ratio": found("time_ratio"),
        "largest_force": found("max_contact_force"),
        "mean_force": found("mean_contact_force")["mean"],
        "over_budget_ms": 1e3 * found("over_budget")["mean"],
    }


def best(rows: Sequence[Mapping[str, Any]]) -> Any:
    """The value that presses least, of those that settle most often and are hardly slower than the fastest of them."""
    most = max(row["reached"] / row["targets"] for row in rows)
    surest = [row for row in rows if row["reached"] / row["targets"] == most and row["reached"]]
    if not surest:
        return None
    fastest = min(row["time_ratio"]["mean"] for row in surest)
    quick = [row for row in surest if row["time_ratio"]["mean"] <= _SLOWER * fastest]
    return min(quick, key=lambda row: row["largest_force"]["mean"])["value"]


def setting_table(report: Report) -> str:
    """The rows, and each method's best value."""
    name = report["setting"]
    headings = ["scene", "method", name, "settled", "time / limit", "peak force, N", "mean force, N"]
    lines, chosen = [], []
    for scene, rows in report["scenes"].items():
        for row in rows:
            ratio, force = row["time_ratio"], row["largest_force"]
            figures = [f"{row['reached']}/{row['targets']}", f"{ratio['mean']:.2f} ± {ratio['sd']:.2f}"]
            figures += [f"{force['mean']:.1f} ± {force['sd']:.1f}", f"{row['mean_force']:.2f}"]
            figures.append(f"{row['over_budget_ms']:.0f}")
            lines.append([scene, row["method"], str(row["value"]), *figures])
        for method in dict.fromkeys(row["method"] for row in rows):
            value = best([row for row in rows if row["method"] == method])
            chosen.append(f"{method} in {scene} {'never settles' if value is None else value}")
    made = table([*headings, "over the budget, ms"], lines)
    return f"{made}\n\nBest {name}: {', '.join(chosen)}."


def _assignments(pairs: Sequence[str]) -> dict[str, Any]:
    """Values by name, from texts such as population=32."""
    split = [pair.partition("=") for pair in pairs]
    wrong = [pair for pair, (name, _, value) in zip(pairs, split, strict=True) if not (name and value)]
    if wrong:
        raise SettingsError(f"--others {' '.join(wrong)}: expected NAME=VALUE, as in population=32")
    return {name: yaml.safe_load(value) for name, _, value in split}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__, spread=True)
    parser.add_argument(
        "name", help="a parameter of section 'planning' or 'impedance', as contact_weight; latency; or period"
    )
    parser.add_argument("values", nargs="+", type=yaml.safe_load, metavar="VALUE", help="values that it takes")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: ball wall)")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="as for table1 (default: contact_reach)")
    parser.add_argument("--targets", type=int, help="episodes per scene, method and value (default: 10)")
    parser.add_argument("--seed", type=int, help="of the first target (default: 0)")
    parser.add_argument("--others", nargs="+", metavar="NAME=VALUE", help="other settings, the same for each value")
    parser.add_argument("--spheres", type=int, help="that plans look at (default: as many as the scene has)")
    parser.add_argument("--arm", metavar="ARM", help="a name, or the path of a URDF or YAML file (default: iiwa14)")
    options = given(parser, arguments)
    file, workers = options.pop("file", None), options.pop("workers", None)
    bench_setting(Sweep(**options), file, workers)


if __name__ == "__main__":
    run_command(main)
