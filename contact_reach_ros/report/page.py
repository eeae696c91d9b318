"""`contact-reach report`: one HTML page about one or more bags, which needs nothing but a browser."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader

from contact_reach_ros.errors import BagError
from contact_reach_ros.report import charts
from contact_reach_ros.report.bag import ReportBag, as_json, metrics, number, quantity
from contact_reach_ros.resources import write_json, write_text

_TEMPLATES = Path(__file__).with_name("template")
_LEVELS = {0: "ok", 1: "contact", 2: "stop", 3: "stale"}
_MOST_EVENTS = 500
"""Number of events that the page lists for a bag."""


class _Section(NamedTuple):
    """Name in links, heading, a sentence below it, and what makes each chart of a bag."""

    anchor: str
    title: str
    caption: str
    make: Sequence[Callable[[ReportBag], charts.Chart]]


def run_report(bags: Sequence[Path], output: Path | None = None, file: Path | None = None) -> int:
    """Write the report; returns 0.

    Parameters
    ----------
    bags
        Directories or mcap files.
    output
        The page; next to the first bag, with the bag's name, when None.
    file
        JSON file for the numbers.

    Raises
    ------
    BagError
        If none of the bags can be read, or a file cannot be written.
    """
    read, failures = [], []
    for path in bags:
        try:
            read.append(ReportBag(path, _label(path, bags)))
        except BagError as error:
            failures.append(error)
    if not read:
        raise failures[0]
    for failure in failures:
        print(f"left out: {failure}")
    whole = read[0].path.resolve()
    output = output or whole.with_name(f"{_stem(whole)}.html")
    write_text(output, page(read, [str(failure) for failure in failures]))
    if file is not None:
        write_json(file, {"bags": [as_json(bag) for bag in read]})
    for bag in read:
        print(f"{bag.label}: {bag.verdict}")
        for note in bag.notes:
            print(f"  note: {note}")
    print(f"report: {output} ({output.stat().st_size / 1e6:.1f} MB)")
    return 0


def page(bags: Sequence[ReportBag], failures: Sequence[str] = ()) -> str:
    """The whole page; `failures` are notes on bags that could not be read."""
    # The library is large, and only the page needs it.
    from plotly.offline import get_plotlyjs

    sections = [_section(section, bags) for section in _SECTIONS]
    figures = [chart for section in sections for _, chart in section["charts"] if chart["data"]]
    for place, chart in enumerate(figures):
        chart["number"] = place
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": number, "quantity": quantity}
    return environment.get_template("page.html").render(
        title="Contact reach: " + " and ".join(bag.label for bag in bags),
        plotly=get_plotlyjs(),
        bags=bags,
        failures=failures,
        **_numbers(bags),
        sections=sections,
        # '<' could end the script element.
        figures=json.dumps(figures, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        tables=_configuration(bags),
        longest_curve=2 * charts.BINS,
        levels=_LEVELS,
        most_events=_MOST_EVENTS,
    )


def _label(path: Path, paths: Sequence[Path]) -> str:
    """The bag's name; with the folder where two have the same."""
    path = path.resolve()
    same = sum(other.resolve().name == path.name for other in paths) > 1
    return f"{path.parent.name}_{_stem(path)}" if same else _stem(path)


def _stem(path: Path) -> str:
    """The name of a bag, which may have dots of its own."""
    return path.name.removesuffix(".mcap")


_SECTIONS = (
    _Section("distance", "Distance", "Distance of the flange from the goal.", [charts.distance_chart]),
    _Section(
        "contact",
        "Contact force",
        "The simulation's true force on each link, as in the paper's Fig. 5, against the contact budget.",
        [charts.contact_chart],
    ),
    _Section(
        "external-torque",
        "External torque",
        "The observer's estimate. Dashed: the threshold that stops the arm at rest; it grows with the joint's speed.",
        [charts.external_torque_chart],
    ),
    _Section(
        "command",
        "Commanded torque",
        "Sent by the controller. Dashed: the limits; those of the strong joints lie outside of the picture.",
        [charts.command_chart],
    ),
    _Section("joints", "Joints", "Joint angles. Dashed: the limits of the data sheet.", [charts.joint_chart]),
    _Section(
        "plans",
        "Plans",
        "Solve time of each plan, by the reason that ended the search, and the terms of its cost.",
        [charts.solve_chart, charts.cost_chart],
    ),
)


def _section(section: _Section, bags: Sequence[ReportBag]) -> dict[str, Any]:
    """Contents of a section for the template: its charts with their headings."""
    placed = [(bag.label if len(bags) > 1 else "", make(bag)) for make in section.make for bag in bags]
    return {**section._asdict(), "charts": placed}


def _numbers(bags: Sequence[ReportBag]) -> dict[str, Any]:
    """Numbers of the summary for the template: name, unit, and the values of the bags with their difference."""
    found = [metrics(bag) for bag in bags]
    heads = [bag.label for bag in bags]
    rows = [(name, unit, [numbers[name][0] for numbers in found]) for name, (_, unit) in found[0].items()]
    if len(bags) == 2:
        heads.append("difference")
        rows = [(name, unit, [*values, values[0] - values[1]]) for name, unit, values in rows]
    return {"heads": heads, "numbers": rows}


def _configuration(bags: Sequence[ReportBag]) -> list[dict[str, Any]]:
    """Settings of the nodes, custom data and numbers of messages of all bags, side by side."""
    nodes = sorted({node for bag in bags for node in bag.settings})
    tables = [_table(node, [bag.settings.get(node, {}) for bag in bags]) for node in nodes]
    tables.append(_table("kept with the bag", [bag.reader.custom_data for bag in bags]))
    counts = [{name: topic.message_count for name, topic in sorted(bag.reader.topics.items())} for bag in bags]
    return [*tables, _table("messages by topic", counts, mark=False)]


def _table(title: str, columns: Sequence[Mapping[str, Any]], mark: bool = True) -> dict[str, Any]:
    """Rows of a table with a column for each bag; `mark` those that differ."""
    keys = dict.fromkeys(key for column in columns for key in column)
    cells = {key: [column.get(key, "") for column in columns] for key in keys}
    differs = {key: mark and any(value != values[0] for value in values) for key, values in cells.items()}
    rows = [{"key": key, "cells": values, "differs": differs[key]} for key, values in cells.items()]
    return {"title": title, "rows": rows, "differing": sum(differs.values())}
