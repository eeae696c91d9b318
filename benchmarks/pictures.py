"""Pictures of the tables: each method's success, time and force with its interval."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import paper
from benchmarks.claims import Results
from benchmarks.output import Report
from benchmarks.statistics import Estimate, estimate
from contact_reach_ros.drawing.palette import BLUE, GREEN, ORANGE, VERMILION

_OURS, _OTHER = BLUE, "#aaaaaa"
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE)


def plot_clutter(report: Report, file: Path) -> None:
    """Draw how often each method settles and how hard it presses, with intervals of 95 %, for the file `file`."""
    names = list(report["methods"])[::-1]
    figure = Figure((9.0, 1.2 + 0.35 * len(names)), layout="constrained")
    success, force, against = figure.subplots(1, 3, sharey=True)
    for axes, label, key in (
        (success, "settles at the goal, share of scenes", "settled"),
        (force, "peak force, all scenes, N", "peak_force_N"),
    ):
        _bars(axes, [_estimate(report["methods"][name][key]) for name in names], names)
        axes.set_xlabel(label)
    success.set_xlim(0.0, 1.0)
    _bars(against, [_estimate(report["methods"][name]["against"]["peak_force_N"]) for name in names], names)
    against.axvline(0.0, color="black", linewidth=0.8)
    against.set_xlabel("the same less the method's,\nwhere both settle, N")
    success.set_yticks(range(len(names)), names)
    figure.suptitle(f"{report['scenes']} random scenes; bars: 95 %")
    FigureCanvasAgg(figure).print_png(file)


def plot_table1(reports: Sequence[Report], file: Path) -> None:
    """Draw time and peak force of each method in each scene, for runs with different presets and for the paper."""
    scenes = list(dict.fromkeys(scene for report in reports for scene in report["grid"]["scenes"]))
    figure = Figure((9.0, 0.6 + 2.4 * len(scenes)), layout="constrained")
    grid = figure.subplots(len(scenes), 2, squeeze=False)
    rows = [(report["settings"]["preset"], method) for report in reports for method in report["grid"]["methods"]]
    names = [f"{preset}: {method}" for preset, method in rows][::-1]
    published = list(dict.fromkeys(method for _, method in rows))
    names = [*[f"paper: {method}" for method in published][::-1], *names]
    for scene, line in zip(scenes, grid, strict=True):
        for axes, name, label in zip(line, ("time", "max_contact_force"), ("time, s", "peak force, N"), strict=True):
            found = [_published(scene, method, name) for method in published][::-1]
            for report in reports[::-1]:
                results, goal = Results(report["episodes"]), report["grid"]["goals"][0]
                found += [
                    estimate(list(results.by_target(scene, goal, method, name).values()))
                    for method in report["grid"]["methods"][::-1]
                ]
            _bars(axes, found, names)
            axes.set(title=scene, xlabel=label)
            axes.set_xlim(left=0.0)
        line[0].set_yticks(range(len(names)), names, fontsize=7)
        line[1].set_yticks(range(len(names)), [""] * len(names))
    FigureCanvasAgg(figure).print_png(file)


def plot_setting(report: Report, file: Path) -> None:
    """Draw peak force and settling time over the values, evenly spaced, one row of charts for each scene."""
    figure = Figure((9.0, 1.0 + 2.6 * len(report["scenes"])), layout="constrained")
    grid = figure.subplots(len(report["scenes"]), 2, squeeze=False)
    for (scene, rows), line in zip(report["scenes"].items(), grid, strict=True):
        values = [f"{value:g}" for value in dict.fromkeys(row["value"] for row in rows)]
        for axes, name, label in zip(
            line, ("largest_force", "time_ratio"), ("peak force, N", "time to settle / limit"), strict=True
        ):
            methods = dict.fromkeys(row["method"] for row in rows)
            for above, (method, colour) in enumerate(zip(methods, _COLOURS, strict=False)):
                own = [row for row in rows if row["method"] == method]
                places = [values.index(f"{row['value']:g}") for row in own]
                means, spreads = ([row[name][key] for row in own] for key in ("mean", "sd"))
                axes.errorbar(places, means, spreads, color=colour, capsize=3, label=method, marker="o")
                for place, mean, row in zip(places, means, own, strict=True):
                    if name == "largest_force" and row["reached"] < row["targets"]:
                        text = f"{row['reached']}/{row['targets']}"
                        offset = (4, 4 + 11 * above)
                        axes.annotate(text, (place, mean), offset, textcoords="offset points", color=colour)
            axes.set(title=scene, xlabel=report["setting"], ylabel=label)
            axes.set_xticks(range(len(values)), values)
            axes.set_xlim(-0.3, len(values) - 0.5)
            axes.set_ylim(bottom=0.0)
            axes.grid(alpha=0.3)
        line[0].legend()
    FigureCanvasAgg(figure).print_png(file)


def _published(scene: str, method: str, name: str) -> Estimate:
    """The paper's figure, with its standard deviation in place of an interval."""
    cell = paper.TABLE_1.get((scene, method))
    if cell is None:
        return estimate([])
    mean, spread = (cell.time, cell.time_sd) if name == "time" else (cell.force, cell.force_sd)
    return Estimate(mean, mean - spread, mean + spread)


def _estimate(found: dict[str, Any]) -> Estimate:
    values = [found["mean"], *found["ci95"]]
    return Estimate(*(float("nan") if value is None else value for value in values))


def _bars(axes: Axes, found: Sequence[Estimate], names: Sequence[str]) -> None:
    """A bar for each, with its interval; the method's own in colour."""
    for place, (one, name) in enumerate(zip(found, names, strict=True)):
        ours = name.endswith(paper.METHOD)
        axes.barh(place, 0.0 if one.mean != one.mean else one.mean, color=_OURS if ours else _OTHER)
        if one.mean == one.mean and one.low == one.low:
            axes.plot([one.low, one.high], [place, place], color="black", linewidth=1.2)
    axes.grid(axis="x", alpha=0.3)
