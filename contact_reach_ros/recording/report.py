"""`contact-reach report`: one HTML page about one or more bags, which needs nothing but a browser."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording import report_charts as charts
from contact_reach_ros.recording.envelope import BINS, samples_per_bin
from contact_reach_ros.recording.recompute import Other
from contact_reach_ros.recording.report_bag import ReportBag, as_json, metrics, read_report_bag
from contact_reach_ros.recording.report_charts import Chart
from contact_reach_ros.recording.report_scene import scene_chart
from contact_reach_ros.recording.report_tables import write_tables
from contact_reach_ros.recording.signals import Series

Array = NDArray[np.float64]

_PAGE = Path(__file__).with_name("report_page")
_LEVELS = {0: "ok", 1: "contact", 2: "stop", 3: "stale"}
_MAXIMUM_EVENTS = 500


@dataclass(frozen=True)
class ReportOptions:
    """What the command line asks for."""

    bags: tuple[Path, ...]
    output: Path | None = None
    """The page; beside the first bag, and named as it is, when None."""
    json: Path | None = None
    csv: Path | None = None
    """Directory for tables."""
    other: Path | None = None
    """Parameter file: what it would have done becomes a second curve."""


@dataclass(frozen=True)
class _Section:
    """A part of the page: its charts are made for each bag, with a difference of two where there is one."""

    anchor: str
    title: str
    caption: str
    make: Sequence[Callable[[ReportBag], Chart]]
    compare: Callable[[ReportBag, ReportBag], Chart] | None = None


def run_report(options: ReportOptions) -> int:
    """Write the report; returns 0.

    Raises
    ------
    BagError
        If none of the bags can be read, or a file cannot be written.
    SettingsError
        If the other settings are not accepted.
    """
    bags, failures = [], []
    other = Other(options.other)
    for path in options.bags:
        try:
            bags.append(read_report_bag(path, _label(path, options.bags), other))
        except BagError as error:
            failures.append(error)
    if not bags:
        raise failures[0]
    for failure in failures:
        print(f"left out: {failure}")
    output = options.output or bags[0].path.with_suffix(".html")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(page(bags, [str(failure) for failure in failures]), encoding="utf-8")
        if options.json is not None:
            options.json.write_text(json.dumps(report_json(bags), indent=2, allow_nan=False) + "\n")
        if options.csv is not None:
            for bag in bags:
                write_tables(bag, options.csv / bag.label if len(bags) > 1 else options.csv)
    except OSError as error:
        raise BagError(f"{error.filename or output}: cannot be written: {error.strerror}") from error
    for bag in bags:
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
    sections = [_summary(bags, failures)]
    links = [("summary", "Summary")]
    for section in _SECTIONS:
        sections.append(_section(section, bags, figures))
        links.append((section.anchor, section.title))
    sections += [_events(bags), _configuration(bags)]
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


def _difference(
    pick: Callable[[ReportBag], Iterator[tuple[str, Array, Array]]], title: str, unit: str
) -> Callable[[ReportBag, ReportBag], Chart]:
    def compare(first: ReportBag, second: ReportBag) -> Chart:
        others = {name: (time, values) for name, time, values in pick(second)}
        shared = [(name, time, values, *others[name]) for name, time, values in pick(first) if name in others]
        return charts.difference_chart(shared, f"difference: {title}", unit)

    return compare


def _distance(bag: ReportBag) -> Iterator[tuple[str, Array, Array]]:
    if bag.episode is not None:
        time, distance = bag.episode.distance
        yield "distance", time - bag.zero, distance


def _force(bag: ReportBag) -> Iterator[tuple[str, Array, Array]]:
    force = bag.signals.contact_force
    yield "largest of any link", force.time - bag.zero, force.column("max")


def _joints(series: Callable[[ReportBag], Series]) -> Callable[[ReportBag], Iterator[tuple[str, Array, Array]]]:
    def pick(bag: ReportBag) -> Iterator[tuple[str, Array, Array]]:
        found = series(bag)
        for joint in range(found.values.shape[1]):
            yield f"A{joint + 1}", found.time - bag.zero, found.values[:, joint]

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
        "As in the paper's Fig. 5: what the simulation knows of each link's contacts, against the contact budget.",
        [charts.contact_chart],
        _difference(_force, "contact force [N]", "N"),
    ),
    _Section(
        "external-torque",
        "External torque",
        "What the observer sees. Dashed: what stops the arm at rest; it grows with a joint's speed, which the chart of "
        "shares takes into account.",
        [charts.external_torque_chart, charts.threshold_chart],
        _difference(_joints(lambda bag: bag.signals.external_torque), "external torque [Nm]", "Nm"),
    ),
    _Section(
        "command",
        "Commanded torque",
        "What the controller sends; the limits of the strong joints lie outside of the picture.",
        [charts.command_chart, charts.command_share_chart],
        _difference(_joints(lambda bag: bag.signals.command), "commanded torque [Nm]", "Nm"),
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
        _difference(_joints(lambda bag: bag.signals.position), "joint angle [rad]", "rad"),
    ),
    _Section(
        "timing",
        "Timing",
        "Of real time, when messages were sent. In lockstep the robot's clock waits for the nodes, and this tells how "
        "fast they were, not how regular.",
        [charts.jitter_chart, charts.round_trip_chart],
    ),
    _Section("scene", "Path", "The flange's way, the arm along it (dark: later), obstacles, contacts.", [scene_chart]),
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
    tall = " tall" if chart.get("tall") else ""
    return f'<div class="chart">{head}<div class="plot{tall}" data-chart="{len(figures) - 1}"></div>{note}</div>'


def _summary(bags: Sequence[ReportBag], failures: Sequence[str]) -> str:
    verdicts = "".join(
        f'<div class="verdict{" good" if bag.good else ""}"><h3>{escape(bag.label)}</h3><strong>{escape(bag.verdict)}'
        f'</strong><p class="note">{escape(_origin(bag))}</p></div>'
        for bag in bags
    )
    numbers = [metrics(bag) for bag in bags]
    if len(bags) == 1:
        body = "".join(
            f'<div class="tile"><b>{escape(_quantity(value, unit))}</b><span>{escape(name)}</span></div>'
            for name, (value, unit) in numbers[0].items()
        )
        body = f'<div class="tiles">{body}</div>'
    else:
        body = _comparison(bags, numbers)
    notes = [*failures, *(f"{bag.label}: {note}" if len(bags) > 1 else note for bag in bags for note in bag.notes)]
    notes += [_thinning(bags)]
    listed = "".join(f"<li>{escape(note)}</li>" for note in notes if note)
    return (
        f'<section id="summary"><h2>Summary</h2><div class="verdicts">{verdicts}</div>{body}'
        f'<ul class="note">{listed}</ul></section>'
    )


def _comparison(bags: Sequence[ReportBag], numbers: Sequence[Mapping[str, tuple[float, str]]]) -> str:
    heads = "".join(f'<th class="number">{escape(bag.label)}</th>' for bag in bags)
    if len(bags) == 2:
        heads += '<th class="number">difference</th>'
    rows = []
    for name, (_, unit) in numbers[0].items():
        values = [found[name][0] for found in numbers]
        if len(bags) == 2:
            values.append(values[0] - values[1])
        cells = "".join(f'<td class="number">{_number(value)}</td>' for value in values)
        rows.append(f"<tr><td>{escape(name)}{f' [{escape(unit)}]' if unit else ''}</td>{cells}</tr>")
    return f'<div class="scroll"><table><tr><th></th>{heads}</tr>{"".join(rows)}</table></div>'


def _origin(bag: ReportBag) -> str:
    kept = bag.reader.summary.custom_data
    words = [f"{key} {kept[key]}" for key in ("scene", "seed") if key in kept]
    words.append("lockstep" if bag.signals.in_lockstep else "real time")
    words.append(f"{bag.reader.summary.message_count} messages")
    words += [f"{kept['messages_lost']} lost"] if "messages_lost" in kept else []
    return ", ".join(words)


def _thinning(bags: Sequence[ReportBag]) -> str:
    longest = max(len(bag.signals.position.time) for bag in bags)
    size = samples_per_bin(longest)
    if size == 1:
        return "Curves show every sample."
    return (
        f"Curves of more than {2 * BINS} samples show the least and the greatest value of every {size} samples in a "
        "row (less in shorter ones), so that no peak is lost; --csv writes all samples."
    )


def _events(bags: Sequence[ReportBag]) -> str:
    parts = []
    for bag in bags:
        rows = [
            f'<tr><td class="number">{event.time - bag.zero:.3f}</td><td>{_LEVELS.get(event.level, event.level)}</td>'
            f'<td>{escape(event.name)}</td><td class="wide">{escape(event.message)}</td></tr>'
            for event in bag.signals.safety[:_MAXIMUM_EVENTS]
        ]
        heading = f"<h3>{escape(bag.label)}</h3>" if len(bags) > 1 else ""
        more = len(bag.signals.safety) - len(rows)
        rest = f'<p class="note">and {more} more: see --json</p>' if more > 0 else ""
        empty = "" if rows else '<p class="note">none recorded</p>'
        head = '<tr><th class="number">time [s]</th><th>level</th><th>who</th><th>what</th></tr>' if rows else ""
        table = f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'
        parts.append(f'<div class="chart">{heading}{table}{empty}{rest}</div>')
    return f'<section id="events"><h2>Events</h2><div class="charts">{"".join(parts)}</div></section>'


def _configuration(bags: Sequence[ReportBag]) -> str:
    nodes = sorted({node for bag in bags for node in bag.signals.settings})
    parts = [_details(node, _side_by_side([bag.signals.settings.get(node, {}) for bag in bags])) for node in nodes]
    parts.append(_details("kept with the bag", _side_by_side([bag.reader.summary.custom_data for bag in bags])))
    counts = [{name: topic.message_count for name, topic in sorted(bag.reader.topics().items())} for bag in bags]
    parts.append(_details("messages by topic", _side_by_side(counts), mark=False))
    return f'<section id="configuration"><h2>Configuration</h2>{"".join(parts)}</section>'


def _side_by_side(told: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Values of all bags by key, empty where one has none."""
    keys = dict.fromkeys(key for values in told for key in values)
    return {key: [values.get(key, "") for values in told] for key in keys}


def _details(title: str, rows: Mapping[str, Sequence[Any]], mark: bool = True) -> str:
    lines = []
    for key, values in rows.items():
        differs = mark and any(value != values[0] for value in values)
        cells = "".join(f'<td class="wide">{escape(str(value))}</td>' for value in values)
        lines.append(f"<tr{' class=differs' if differs else ''}><td>{escape(key)}</td>{cells}</tr>")
    differing = sum("class=differs" in line for line in lines)
    hint = f" ({differing} differ)" if differing else ""
    return (
        f'<details><summary>{escape(title)}{hint}</summary><div class="scroll"><table>{"".join(lines)}</table></div>'
        "</details>"
    )


def _quantity(value: float, unit: str) -> str:
    if unit == "µs" and abs(value) >= 10_000:
        value, unit = value / 1000, "ms"
    return f"{_number(value)} {unit}" if np.isfinite(value) else "–"


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.3g}"
