"""The tables of Table I in Markdown: a row for each scene and method."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.claims import Results, plus_minus
from contact_reach_ros.experiments.output import Report, table

GOAL_NAMES = {"hold": "orientation held", "free": "position only"}

_COLUMNS = (
    # heading, figure, factor to its unit, digits
    ("time / limit", "time_ratio", 1.0, 2),
    ("external torque, Nm", "max_external_torque", 1.0, 1),
    ("impulse, N s", "contact_impulse", 1.0, 2),
    ("over ε, ms", "over_budget", 1e3, 0),
    ("path, m", "path_length", 1.0, 3),
    ("path / straight", "path_ratio", 1.0, 2),
    ("jerk, m/s³", "jerk", 1.0, 1),
    ("end error, mm", "end_error", 1e3, 1),
    ("end speed, m/s", "end_speed", 1.0, 3),
    ("plans", "plans", 1.0, 0),
)


def result_tables(report: Report, results: Results) -> Iterator[str]:
    """A table for each kind of goal, under a heading."""
    headings = [
        "scene",
        "method",
        "reached",
        "time, s",
        "paper",
        "force, N",
        "paper",
        *(heading for heading, *_ in _COLUMNS),
    ]
    for index, goal in enumerate(report["grid"]["goals"]):
        if index:
            yield ""
        yield f"### Goals: {GOAL_NAMES[goal]}"
        yield ""
        cells = itertools.product(report["grid"]["scenes"], report["grid"]["methods"])
        yield table(headings, (_cells(results, scene, goal, method) for scene, method in cells))


def _cells(results: Results, scene: str, goal: str, method: str) -> Iterator[str]:
    episodes = results.of(scene, goal, method)
    published = paper.TABLE_1.get((scene, method))
    yield scene
    yield f"**{method}**" if method == paper.METHOD else method
    yield f"{sum(entry['reached'] for entry in episodes)}/{len(episodes)}"
    yield plus_minus(results.summary(scene, goal, method, "time"))
    if published is not None:
        yield f"{published.time:g} ± {published.time_sd:g}"
    else:
        yield "no path" if (scene, method) in paper.NO_PATH else "–"
    yield plus_minus(results.summary(scene, goal, method, "max_contact_force"))
    yield "–" if published is None else _paper_force(published)
    for _, figure, factor, digits in _COLUMNS:
        found = results.summary(scene, goal, method, figure)
        scaled = type(found)(factor * found.mean, factor * found.sd, found.count)
        yield plus_minus(scaled, digits)


def _paper_force(published: paper.PaperCell) -> str:
    return f"{published.force:g} ± {published.force_sd:g}" if published.force else "0"
