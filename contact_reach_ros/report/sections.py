"""The sections of a report without charts: summary, events and configuration, as HTML."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from contact_reach_ros.report.bag import ReportBag, metrics
from contact_reach_ros.report.envelope import BINS, samples_per_bin

_LEVELS = {0: "ok", 1: "contact", 2: "stop", 3: "stale"}
_MAXIMUM_EVENTS = 500


def summary(bags: Sequence[ReportBag], failures: Sequence[str]) -> str:
    """Verdicts, numbers and notes."""
    verdicts = "".join(map(_verdict, bags))
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
    notes += [_thinning(bags), "Charts begin shortly before the goal; double-click for the whole recording and back."]
    listed = "".join(f"<li>{escape(note)}</li>" for note in notes if note)
    return (
        f'<section id="summary"><h2>Summary</h2><div class="verdicts">{verdicts}</div>{body}'
        f'<ul class="note">{listed}</ul></section>'
    )


def _verdict(bag: ReportBag) -> str:
    command = f"contact-reach view {shlex.quote(str(bag.path))}"
    return (
        f'<div class="verdict{" good" if bag.good else ""}"><h3>{escape(bag.label)}</h3>'
        f'<strong>{escape(bag.verdict)}</strong><p class="note">{escape(_origin(bag))}</p>'
        f'<p class="note">In three dimensions: <code>{escape(command)}</code></p></div>'
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


def events(bags: Sequence[ReportBag]) -> str:
    """A table of the safety events of each bag."""
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


def configuration(bags: Sequence[ReportBag]) -> str:
    """Settings of the nodes, custom data and numbers of messages, side by side."""
    nodes = sorted({node for bag in bags for node in bag.signals.settings})
    parts = [_details(node, _side_by_side([bag.signals.settings.get(node, {}) for bag in bags])) for node in nodes]
    parts.append(_details("kept with the bag", _side_by_side([bag.reader.summary.custom_data for bag in bags])))
    counts = [{name: topic.message_count for name, topic in sorted(bag.reader.topics().items())} for bag in bags]
    parts.append(_details("messages by topic", _side_by_side(counts), mark=False))
    return f'<section id="configuration"><h2>Configuration</h2>{"".join(parts)}</section>'


def _side_by_side(tables: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Values of all bags by key, empty where one has none."""
    keys = dict.fromkeys(key for values in tables for key in values)
    return {key: [values.get(key, "") for values in tables] for key in keys}


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
