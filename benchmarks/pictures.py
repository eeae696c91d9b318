"""Pictures of benchmarks that have run, from their JSON.

`python -m benchmarks.pictures clutter.json clutter.png` draws a run of clutter, setting, fig5, solver, blindness or
factors (whose file is a line of JSON for each episode), and `python -m benchmarks.pictures shipped.json hinge.json
linear.json table1.png` runs of table1 with several presets. The picture is a PNG, or an SVG if its name ends so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import factors, paper
from benchmarks.blindness import HARM
from benchmarks.claims import Results
from benchmarks.output import Report, command_line, read_report, run_command
from benchmarks.solver import LABELS, POINTS
from benchmarks.statistics import Estimate, estimate
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.palette import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILION

_OURS, _OTHER = BLUE, "#aaaaaa"
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, BLACK)


def plot_clutter(report: Report) -> Figure:
    """How often each method settles and how hard it presses, with intervals of 95 %."""
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
    return figure


def plot_table1(reports: Sequence[Report]) -> Figure:
    """Time and peak force of each method in each scene, for runs with different presets and for the paper."""
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
    return figure


def plot_setting(report: Report) -> Figure:
    """Peak force and settling time over the values, evenly spaced, one row of charts for each scene."""
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
    return figure


def plot_fig5(report: Report) -> Figure:
    """The force on the body that is pressed hardest, over time, and the permitted one."""
    figure = Figure((9.0, 3.5), layout="constrained")
    axes = figure.subplots()
    for (method, found), colour in zip(report["methods"].items(), _COLOURS, strict=False):
        profile = found["profile_N"]
        time = report["tick_s"] * np.arange(1, len(profile) + 1)
        axes.plot(time, profile, color=colour, label=f"{method}: {found['outcome']}")
    permitted = report["permitted_force_N"]
    axes.axhline(permitted, color=GREY, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    axes.set(xlabel="time since the goal, s", ylabel="force on the most loaded body, N")
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def plot_solver(report: Report) -> Figure:
    """The excess cost of each solver over time with its interval, one row of charts for each scene."""
    scenes = report["scenes"]
    figure = Figure((10.0, 3.6 * len(scenes)), layout="constrained")
    starts = {"cold": "from standing still", "warm": "from the plan before"}
    grid = figure.subplots(len(scenes), 2, sharex=True, sharey=True, squeeze=False)
    for (scene, race), row in zip(scenes.items(), grid, strict=True):
        milliseconds = 1e3 * np.linspace(0.0, race["seconds"], POINTS)
        for axes, (start, title) in zip(row, starts.items(), strict=True):
            for (name, label), colour in zip(LABELS.items(), _COLOURS, strict=False):
                curve = race[start][name]["curve"]
                axes.plot(milliseconds, [1e3 * entry["mean"] for entry in curve], color=colour, label=label)
                low, high = 1e3 * np.array([entry["ci95"] for entry in curve]).T
                axes.fill_between(milliseconds, low, high, color=colour, alpha=0.15, linewidth=0.0)
            axes.set(title=f"{scene}, {title}", xlabel="time, ms", yscale="log")
            axes.grid(alpha=0.3)
        row[0].set_ylabel("cost above the least found, × 10⁻³")
    grid[0, -1].legend(fontsize="small")
    return figure


def plot_blindness(report: Report) -> Figure:
    """The least forces that are noticed and that stop the arm, along it from base to tip."""
    figure = Figure((9.0, 3.8), layout="constrained")
    axes = figure.subplots()
    links = report["links"]
    for name, label, colour in (("noticed", "noticed", BLUE), ("stops", "stops the arm", VERMILION)):
        for number, link in enumerate(links.values()):
            bins = link["along"]
            places = number + (np.arange(len(bins)) + 0.5) / len(bins)
            p50, p95 = ([one[name][key] if one else np.nan for one in bins] for key in ("p50", "p95"))
            axes.plot(places, p50, color=colour, label="" if number else f"{label}: median, up to the 95th percentile")
            axes.fill_between(places, p50, p95, color=colour, alpha=0.2, linewidth=0.0)
            axes.axvline(number, color=GREY, linewidth=0.5)
    axes.axhline(HARM, color=GREY, linewidth=1.0, linestyle="--", label=f"{HARM:g} N")
    axes.set(ylabel="contact force at rest, N", yscale="log")
    axes.set_xlim(0.0, len(links))
    axes.set_ylim(3.0, 3000.0)
    axes.set_xticks(np.arange(len(links)) + 0.5, links, fontsize="small")
    axes.tick_params(axis="x", length=0.0)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize="small")
    return figure


def plot_factors(report: Report) -> Figure:
    """What each level of a factor changes against the shipped one, with intervals of 95 %, by scene."""
    rows = [
        (f"{scene}: {factor} {level}", own, factor, level)
        for scene, own in factors.by_scene(report["episodes"]).items()
        for factor, level in factors.levels(own)
        if level not in factors.SHIPPED
    ][::-1]
    figure = Figure((9.0, 1.2 + 0.28 * len(rows)), layout="constrained")
    grid = figure.subplots(1, len(factors.FIGURES), sharey=True)
    for axes, (label, of) in zip(grid, factors.FIGURES.items(), strict=True):
        for place, (_, own, factor, level) in enumerate(rows):
            found = factors.effect(own, factor, level, of)[1]
            if found is not None:
                axes.plot([found.low, found.high], [place, place], color=GREY, linewidth=2.0)
                axes.plot(found.mean, place, marker="o", color=_COLOURS[factors.Factors._fields.index(factor)])
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_xlabel(f"change of {label}")
        axes.grid(axis="x", alpha=0.3)
    grid[0].set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize="small")
    return figure


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


PICTURES = {
    "clutter": plot_clutter,
    "setting": plot_setting,
    "fig5": plot_fig5,
    "solver": plot_solver,
    "blindness": plot_blindness,
    "factors": plot_factors,
}
"""Of one report, by benchmark; `plot_table1` takes several."""


def draw(reports: Sequence[Report]) -> Figure:
    """The picture of a benchmark's report, or of several of table1; raises `SettingsError` if there is none."""
    bench = reports[0]["bench"]
    if bench == "table1":
        return plot_table1(reports)
    if bench not in PICTURES:
        raise SettingsError(f"'{bench}' has no picture; expected a run of table1, {', '.join(PICTURES)}")
    if len(reports) > 1:
        raise SettingsError(f"{len(reports)} runs of {bench}: expected one; only runs of table1 are drawn together")
    return PICTURES[bench](reports[0])


def _read(file: Path, bench: str = "") -> Report:
    """A report; factors are a line for each episode."""
    if file.suffix == ".jsonl":
        return {"bench": "factors", "episodes": factors.read(file)}
    return read_report(file, bench)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("reports", nargs="+", type=Path, metavar="JSON", help="what `--json` wrote")
    parser.add_argument("picture", type=Path, metavar="PICTURE", help="PNG or SVG to write")
    options = parser.parse_args(arguments)
    first = _read(options.reports[0])
    figure = draw([first, *(_read(file, first["bench"]) for file in options.reports[1:])])
    # Text stays text, and the same run is drawn to the same bytes.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "contact_reach"}):
        figure.savefig(options.picture, metadata={"Date": None} if options.picture.suffix == ".svg" else None)


if __name__ == "__main__":
    run_command(main)
