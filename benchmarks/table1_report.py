"""Table I and its claims in Markdown, from the JSON of a run alone: every number in the text is computed from it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from benchmarks import paper
from benchmarks.claims import GOAL_NAMES, Results, interval_text, plus_minus
from benchmarks.output import Report, table
from benchmarks.statistics import CONFIDENCE, MIN_TARGETS, corrected, estimate

_COLUMNS = (
    # heading, figure, factor to its unit, digits
    ("time / limit", "time_ratio", 1.0, 2),
    ("first there, s", "entry_time", 1.0, 2),
    ("peak force, N", "max_contact_force", 1.0, 2),
    ("mean force, N", "mean_contact_force", 1.0, 2),
    ("impulse, N s", "contact_impulse", 1.0, 2),
    ("over ε, ms", "over_budget", 1e3, 0),
    ("external torque, Nm", "max_external_torque", 1.0, 1),
    ("path / straight", "path_ratio", 1.0, 2),
    ("plans", "plans", 1.0, 0),
)


def tables(report: Report) -> str:
    """What was run, tables, claims, where a baseline is ahead and why goals were not reached."""
    results = Results(report["episodes"])
    return "\n".join(
        [
            *_run(report),
            "",
            *_tables(report, results),
            "",
            claims_table(report["claims"]),
            "",
            *_losses(report, results),
            *_failures(report),
        ]
    )


def _run(report: Report) -> Iterator[str]:
    grid, settings, machine = report["grid"], report["settings"], report["machine"]
    yield f"`{report['command']}`: {len(report['episodes'])} episodes."
    yield ""
    yield (
        f"Targets {grid['seed']} to {grid['seed'] + grid['targets'] - 1} of each scene, {grid['repeats']} of each; "
        f"{settings['timeout']:g} s to settle; {machine['cpu']}, {machine['cores']} cores."
    )


def _tables(report: Report, results: Results) -> Iterator[str]:
    headings = ["scene", "method", "settled", "time, s", "paper: time, s", "paper: peak force, N"]
    headings += [heading for heading, *_ in _COLUMNS]
    for index, goal in enumerate(report["grid"]["goals"]):
        if index:
            yield ""
        yield f"Goals: {GOAL_NAMES[goal]}."
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
        yield f"{published.force:g} ± {published.force_sd:g}" if published.force else "0"
    else:
        yield from ("no path" if (scene, method) in paper.NO_PATH else "–", "–")
    for _, figure, factor, digits in _COLUMNS:
        found = results.summary(scene, goal, method, figure)
        scaled = type(found)(factor * found.mean, factor * found.sd, found.count)
        yield plus_minus(scaled, digits)


def claims_table(claims: list[Report]) -> str:
    """Claims with their values, intervals and verdicts."""
    rows = (
        [
            claim["claim"],
            GOAL_NAMES[claim["goal"]],
            claim["required"],
            interval_text(claim["value"], claim["ci95"]),
            interval_text(claim["value"], claim["ci_corrected"]).partition(" ")[2] or "–",
            str(claim["targets"]),
            _verdict(claim),
        ]
        for claim in claims
    )
    level = 100 * corrected(len(claims))
    return table(
        ["claim", "goals", "required", f"measured [{100 * CONFIDENCE:g} %]", f"[{level:.2f} %]", "targets", ""], rows
    )


def _verdict(claim: Report) -> str:
    if claim["targets"] < MIN_TARGETS:
        return "too few targets"
    return "met" if claim["met"] else "**not met**"


_NOTICEABLE = {"time": 0.05, "max_contact_force": 0.2}
"""Differences of means that are worth a note, s and N."""


def _losses(report: Report, results: Results) -> Iterator[str]:
    """A line for every figure in which a baseline beats the method for certain."""
    none, grid = True, report["grid"]
    for goal, scene, method in itertools.product(grid["goals"], grid["scenes"], grid["methods"]):
        if method == paper.METHOD or paper.METHOD not in grid["methods"]:
            continue
        for text in _behind(results, scene, goal, method):
            none = False
            yield f"- {scene}, {GOAL_NAMES[goal]}: {text}"
    if none:
        yield "No baseline is ahead in any scene, as far as the differences are certain."


def _behind(results: Results, scene: str, goal: str, method: str) -> Iterator[str]:
    def rate(name: str) -> float:
        episodes = results.of(scene, goal, name)
        return sum(entry["reached"] for entry in episodes) / max(len(episodes), 1)

    if rate(method) > rate(paper.METHOD):
        theirs, ours = (100 * rate(name) for name in (method, paper.METHOD))
        yield f"{method} settles at {theirs:.0f} % of the goals, the method at {ours:.0f} %."
    if not rate(method):
        # Who does not get anywhere presses less.
        return
    for figure, unit, words in (("time", "s", "is faster"), ("max_contact_force", "N", "presses less")):
        ahead = estimate(results.difference(scene, goal, paper.METHOD, method, figure))
        if ahead.low > 0.0 and ahead.mean > _NOTICEABLE[figure]:
            yield f"{method} {words}, by {interval_text(ahead.mean, ahead[1:])} {unit}."


def _failures(report: Report) -> Iterator[str]:
    """Why goals were not reached: how often in each cell, with one of the messages."""
    found: dict[tuple[str, str, str], dict[str, list[str]]] = {}
    for entry in report["episodes"]:
        if not entry["reached"]:
            kind = "stopped" if entry["stop_reason"] else "no plan" if entry["failure"] else "out of time"
            kinds = found.setdefault((entry["scene"], entry["goal"], entry["method"]), {})
            kinds.setdefault(kind, []).append(entry["stop_reason"] or entry["failure"])
    if found:
        yield ""
        yield "Goals that were not reached:"
        yield ""
    for (scene, goal, method), kinds in found.items():
        reasons = [f"{len(why)} × {kind}" + (f" ({why[0]})" if why[0] else "") for kind, why in kinds.items()]
        yield f"- {scene}, {GOAL_NAMES[goal]}, {method}: {'; '.join(reasons)}"
