"""`contact-reach report`: one HTML page about one or more bags, which needs nothing but a browser."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from contact_reach_ros.bags.signals import EpisodeSignals, Series
from contact_reach_ros.errors import BagError
from contact_reach_ros.reexecution.settings import ChangedSettings
from contact_reach_ros.report import charts
from contact_reach_ros.report.bag import ReportBag, as_json, metrics, read_report_bag
from contact_reach_ros.report.curves import Chart
from contact_reach_ros.report.sections import configuration, events, summary
from contact_reach_ros.report.tables import write_tables

_PAGE = Path(__file__).with_name("template")


@dataclass(frozen=True)
class _Section:
    """A section with charts for each bag and, for some quantities, a chart of the difference of two bags."""

    anchor: str
    title: str
    caption: str
    make: Sequence[Callable[[ReportBag], Chart]]
    compare: Callable[[ReportBag, ReportBag], Chart] | None = None


def run_report(
    bags: Sequence[Path],
    output: Path | None = None,
    file: Path | None = None,
    csv: Path | None = None,
    other: Path | None = None,
) -> int:
    """Write the report; returns 0.

    Parameters
    ----------
    bags
        Directories or mcap files.
    output
        The page; beside the first bag, with its name, when None.
    file
        For the numbers, as JSON.
    csv
        Directory for tables.
    other
        Parameter file whose effect, by re-execution, is shown as second curves.

    Raises
    ------
    BagError
        If none of the bags can be read, or a file cannot be written.
    SettingsError
        If the other settings are not accepted.
    """
    read, failures = [], []
    changes = ChangedSettings(other)
    for path in bags:
        try:
            read.append(read_report_bag(path, _label(path, bags), changes))
        except BagError as error:
            failures.append(error)
    if not read:
        raise failures[0]
    for failure in failures:
        print(f"left out: {failure}")
    output = output or read[0].path.with_suffix(".html")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(page(read, [str(failure) for failure in failures]), encoding="utf-8")
        if file is not None:
            file.write_text(json.dumps(report_json(read), indent=2, allow_nan=False) + "\n")
        if csv is not None:
            for bag in read:
                write_tables(bag, csv / bag.label if len(read) > 1 else csv)
    except OSError as error:
        raise BagError(f"{error.filename or output}: cannot be written: {error.strerror}") from error
    for bag in read:
        print(f"{bag.label}: {bag.verdict}")
        for note in bag.notes:
            print(f"  note: {note}")
    print(f"report: {output} ({output.stat().st_size / 1e6:.1f} MB)")
    return 0


def report_json(bags: Sequence[ReportBag]) -> dict[str, Any]:
    """The report for machines: each bag, and the differences of the first two."""
    result: dict[str, Any] = {"bags": [as_json(bag) for bag in bags]}
    if len(bags) > 1:
        first, second = metrics(bags[0]), metrics(bags[1])
        differences = {name: first[name][0] - second[name][0] for name in first}
        result["difference"] = {name: value if np.isfinite(value) else None for name, value in differences.items()}
    return result


def page(bags: Sequence[ReportBag], failures: Sequence[str] = ()) -> str:
    """The whole page."""
    # The library is large, and only the page needs it.
    from plotly.offline import get_plotlyjs

    figures: list[Chart] = []
    sections = [summary(bags, failures)]
    links = [("summary", "Summary")]
    for section in _SECTIONS:
        sections.append(_section(section, bags, figures))
        links.append((section.anchor, section.title))
    sections += [events(bags), configuration(bags)]
    links += [("events", "Events"), ("configuration", "Configuration")]
    parts = {
        "title": escape("Contact reach: " + " and ".join(bag.label for bag in bags)),
        "style": _asset("style.css"),
        "plotly": get_plotlyjs(),
        "links": "".join(f'<a href="#{anchor}">{escape(text)}</a>' for anchor, text in links),
        "body": "\n".join(sections),
        # '<' could end the script element.
        "charts": json.dumps(figures, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "script": _asset("page.js"),
    }
    head, *rest = _asset("page.html").split("{{")
    return head + "".join(parts[name] + text for name, text in (part.split("}}", 1) for part in rest))


def _label(path: Path, paths: Sequence[Path]) -> str:
    """The bag's name; with the folder where two have the same."""
    path = path.resolve()
    same = sum(other.resolve().name == path.name for other in paths) > 1
    return f"{path.parent.name}_{path.stem}" if same else path.stem


def _asset(name: str) -> str:
    return (_PAGE / name).read_text(encoding="utf-8")


def _difference(pick: Callable[[ReportBag], Series], title: str, unit: str) -> Callable[[ReportBag, ReportBag], Chart]:
    """Make the chart of what the first bag has less what the second has, by names."""

    def since_goal(bag: ReportBag) -> Series:
        return pick(bag).since(bag.zero)

    def compare(first: ReportBag, second: ReportBag) -> Chart:
        return charts.difference_chart(since_goal(first), since_goal(second), f"difference: {title}", unit)

    return compare


def _distance(bag: ReportBag) -> Series:
    return bag.episode.distance if bag.episode is not None else Series(np.empty(0), (), np.empty((0, 0)))


def _force(bag: ReportBag) -> Series:
    force = bag.signals.contact_force
    return Series(force.time, ("largest of any link",), force.column("max")[:, None])


def _joints(series: Callable[[EpisodeSignals], Series]) -> Callable[[ReportBag], Series]:
    def pick(bag: ReportBag) -> Series:
        found = series(bag.signals)
        return Series(found.time, tuple(f"A{joint + 1}" for joint in range(len(found.names))), found.values)

    return pick


_SECTIONS = (
    _Section(
        "distance",
        "Distance",
        "Of the flange from the goal.",
        [charts.distance_chart],
        _difference(_distance, "distance [m]", "m"),
    ),
    _Section(
        "contact",
        "Contact force",
        "As in the paper's Fig. 5: the simulation's true forces on each link, against the contact budget.",
        [charts.contact_chart],
        _difference(_force, "contact force [N]", "N"),
    ),
    _Section(
        "external-torque",
        "External torque",
        "The observer's estimate. Dashed: the threshold that stops the arm at rest; it grows with a joint's speed, "
        "which the chart of shares takes into account.",
        [charts.external_torque_chart, charts.threshold_chart],
        _difference(_joints(lambda signals: signals.external_torque), "external torque [Nm]", "Nm"),
    ),
    _Section(
        "command",
        "Commanded torque",
        "Sent by the controller; the limits of the strong joints lie outside of the picture. The spectrum is that of "
        "the way to the goal.",
        [charts.command_chart, charts.command_share_chart, charts.spectrum_chart],
        _difference(_joints(lambda signals: signals.command), "commanded torque [Nm]", "Nm"),
    ),
    _Section(
        "plans",
        "Plans",
        "How old each plan became before the next took effect; the time that each took, by what ended the search; and "
        "the terms of its cost.",
        [charts.plan_age_chart, charts.solve_chart, charts.cost_chart],
    ),
    _Section(
        "joints",
        "Joints",
        "Angles against the limits of the data sheet.",
        [charts.joint_chart],
        _difference(_joints(lambda signals: signals.position), "joint angle [rad]", "rad"),
    ),
    _Section(
        "timing",
        "Timing",
        "In real time, when messages were sent. In lockstep the robot's clock waits for the nodes, and this shows how "
        "fast they were, not how regular.",
        [charts.jitter_chart, charts.round_trip_chart],
    ),
)


def _section(section: _Section, bags: Sequence[ReportBag], figures: list[Chart]) -> str:
    parts = []
    for make in section.make:
        for bag in bags:
            parts.append(_place(make(bag), bag.label if len(bags) > 1 else "", figures))
    if section.compare is not None and len(bags) > 1:
        words = f"{bags[0].label} less {bags[1].label}"
        parts.append(_place(section.compare(bags[0], bags[1]), words, figures))
    return (
        f'<section id="{section.anchor}"><h2>{escape(section.title)}</h2><p class="caption">{escape(section.caption)}'
        f'</p><div class="charts">{"".join(parts)}</div></section>'
    )


def _place(chart: Chart, heading: str, figures: list[Chart]) -> str:
    head = f"<h3>{escape(heading)}</h3>" if heading else ""
    if not chart["data"]:
        what = chart["layout"].get("yaxis", {}).get("title", {}).get("text", "")
        missing = chart.get("missing", "nothing to compare")
        return f'<div class="chart">{head}<div class="missing">{escape(what)}<br>{escape(missing)}</div></div>'
    figures.append(chart)
    note = f'<p class="note">{escape(chart["note"])}</p>' if "note" in chart else ""
    return f'<div class="chart">{head}<div class="plot" data-chart="{len(figures) - 1}"></div>{note}</div>'
