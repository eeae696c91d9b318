"""Table I and its claims in Markdown, from the JSON of a run alone: every number in the text is computed from it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

from contact_reach_ros.experiments import paper
from contact_reach_ros.experiments.baselines.methods import METHODS
from contact_reach_ros.experiments.claims import Claim, Ratio, Results, claims, plus_minus, ratio_text
from contact_reach_ros.experiments.grid import PATH_PATIENCE
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

_PICTURES = {
    "fig4.png": "Trajectories, as in Fig. 4 of the paper",
    "fig5.png": "Contact force over time, as in Fig. 5 of the paper",
}

_LEGEND = """\
Mean ± standard deviation over targets and repeats; times, and what depends on them, over the episodes that reached \
the goal. *Force* is the largest force on any one body of the arm, from the simulation; *external torque* the largest \
residual of the momentum observer on any joint, which includes the friction it does not know; *limit* is the time that \
the bound γ on Δx permits at best, max |d_i| / (γ Kp/Kd); *impulse* the integral of the force; *over ε* the time above \
the permitted force; *path / straight* the flange's path over the distance between its ends; *jerk* the root mean \
square of the third derivative of the flange's position, from a Savitzky-Golay filter of 0.1 s; *end error* the \
distance from the target when the episode ended, *end speed* that of the flange then. A goal is reached within \
{success:g} mm, in {timeout:g} s at most, or {patience:g} s by methods that follow a path."""

_RATIO_LEGEND = """\
A ratio is that of the means over all episodes, on targets for which both methods have the figure, with the {share} % \
interval of a bootstrap over targets; *paired median* is the median over targets of the ratio within a target. Forces \
count from all episodes, times only from those that reached the goal."""

_CONDITIONS_LEGEND = "Where the whole interval of a ratio is above 1, planning the null space pays for certain."

_LOSSES_LEGEND = """\
A method that plans more often, see below, moves x_d on more often and is faster by that; `joint_torque` is not held \
to the speed γ Kp/Kd. Table I has time, force and path of all."""


def _legend(settings: Report) -> str:
    timeout = settings["timeout"]
    return _LEGEND.format(success=1e3 * settings["success"], timeout=timeout, patience=PATH_PATIENCE * timeout)


def tables(report: Report) -> str:
    """Tables and claims, for the terminal."""
    results = Results(report["episodes"])
    return "\n".join([*_tables(report, results), "", _claims(report, results)])


def document(report: Report, page: Path, other: Report | None = None) -> str:
    """The page of results, for the file `page`, with the pictures beside it.

    `other`: a run with other goals, which shows which condition decides.
    """
    results = Results(report["episodes"])
    both = report if other is None else _joined(report, other)
    parts = [
        "# Results",
        "",
        "The paper's Table I, measured in simulation. This page is written by",
        "",
        "```",
        *_commands(report, page, other),
        "```",
        "",
        *_run(report),
        "",
        "## Table I",
        "",
        *_tables(report, results),
        "",
        _legend(report["settings"]),
        "",
        "## What is demanded",
        "",
        _claims(report, results),
        "",
        _RATIO_LEGEND.format(share=95),
        "",
        "## Which condition decides",
        "",
        *_conditions(both, Results(both["episodes"])),
        "",
        _CONDITIONS_LEGEND,
        "",
        "## Where a baseline is ahead",
        "",
        *_losses(report, results),
        "",
        _LOSSES_LEGEND,
        *_failures(report),
        "",
        "## Time of a plan",
        "",
        *_latencies(report),
        "",
        *_pictures(page.parent),
    ]
    return "\n".join(parts).rstrip() + "\n"


def _joined(report: Report, other: Report) -> Report:
    """The episodes of both; goals of the first that the second has as well are those of the first."""
    own = report["grid"]["goals"]
    added = [entry for entry in other["episodes"] if entry["goal"] not in own]
    goals = [*own, *(goal for goal in other["grid"]["goals"] if goal not in own)]
    return {**report, "grid": {**report["grid"], "goals": goals}, "episodes": [*report["episodes"], *added]}


def _commands(report: Report, page: Path, other: Report | None) -> Iterator[str]:
    if other is None:
        yield f"{report['command']} --json table1.json --results docs/{page.name}"
        return
    yield f"{report['command']} --json table1.json"
    yield f"{other['command']} --json other.json"
    yield f"contact-reach bench table1 --report-only --json table1.json --other other.json --results docs/{page.name}"


def _run(report: Report) -> Iterator[str]:
    grid, machine, settings = report["grid"], report["machine"], report["settings"]
    planning, controller = settings["planning"], settings["controller"]["impedance"]
    first, count = grid["seed"], grid["targets"]
    seeds = f"seeds {first} to {first + count - 1}" if count > 1 else f"seed {first}"
    yield (
        f"{len(report['episodes'])} episodes: {count} target{_s(count)} per scene ({seeds}), {grid['repeats']} "
        f"repeat{_s(grid['repeats'])} of each with other random numbers of solver and sensors."
    )
    yield ""
    yield (
        f"Planner: k = {planning['population']}, k_top = {planning['elite']}, H = {planning['horizon']} knots of "
        f"{planning['knot_duration']:g} s, γ = {planning['translation_bound']:g} m, "
        f"{planning['rotation_bound']:g} rad, {planning['posture_bound']:g} rad, no deadline. "
        f"Controller: Kp = {controller['task_stiffness']:g}, "
        f"Kd = {controller['task_damping']:g}, Kqp = {controller['null_stiffness']:g}, "
        f"Kqd = {controller['null_damping']:g}. ε = {settings['budget']['permitted_force']:g} N. "
        "A new plan is begun when the last one is ready, and takes effect when it is ready itself: after the time that "
        "a plan takes, below."
    )
    yield ""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "jax", "mujoco", "pin") if name in machine)
    yield f"Machine: {machine['cpu']}, {machine['cores']} cores; {versions}."


def _tables(report: Report, results: Results) -> Iterator[str]:
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


def _claims(report: Report, results: Results) -> str:
    rows = (
        [claim.text, GOAL_NAMES[claim.goal], claim.required, claim.measured or "–", _verdict(claim)]
        for claim in claims(results, report["grid"]["scenes"], report["grid"]["goals"])
    )
    return table(["claim", "goals", "required", "measured", ""], rows)


def _verdict(claim: Claim) -> str:
    return {True: "met", False: "**not met**", None: "not measured"}[claim.met]


def _conditions(report: Report, results: Results) -> Iterator[str]:
    """Reference posture against the method, with the orientation held and free."""
    goals = report["grid"]["goals"]
    needed = {paper.METHOD, paper.REFERENCE_POSTURE}
    if not needed <= set(report["grid"]["methods"]):
        yield f"Not measured: that takes {' and '.join(sorted(needed))}."
        return
    rows = []
    for scene in report["grid"]["scenes"]:
        for goal in goals:
            ratio = results.ratio(scene, goal, paper.REFERENCE_POSTURE, paper.METHOD, "max_contact_force")
            rows.append(
                [
                    scene,
                    GOAL_NAMES[goal],
                    plus_minus(results.summary(scene, goal, paper.METHOD, "max_contact_force")),
                    plus_minus(results.summary(scene, goal, paper.REFERENCE_POSTURE, "max_contact_force")),
                    "–" if ratio is None else ratio_text(ratio),
                ]
            )
    yield table(["scene", "goals", "force of the method, N", "of reference posture, N", "ratio"], rows)


def _surely_below(ratio: Ratio) -> bool:
    return ratio.high < 1.0 or (ratio.high != ratio.high and ratio.of_means < 1.0)


_NOTICEABLE = {"time": 0.05, "max_contact_force": 0.2}
"""Differences of means that are worth a note, s and N."""


def _losses(report: Report, results: Results) -> Iterator[str]:
    """A line for every figure in which a baseline beats the method for certain."""
    none = True
    grid = report["grid"]
    for goal in grid["goals"]:
        for scene in grid["scenes"]:
            for method in grid["methods"]:
                if method == paper.METHOD or paper.METHOD not in grid["methods"]:
                    continue
                for text in _behind(results, scene, goal, method):
                    none = False
                    yield f"- {scene}, {GOAL_NAMES[goal]}: {text}"
    if none:
        yield "Nowhere, as far as the differences are certain."


def _behind(results: Results, scene: str, goal: str, method: str) -> Iterator[str]:
    def rate(name: str) -> float:
        episodes = results.of(scene, goal, name)
        return sum(entry["reached"] for entry in episodes) / max(len(episodes), 1)

    if rate(method) > rate(paper.METHOD):
        yield f"{method} reaches {100 * rate(method):.0f} % of the goals, the method {100 * rate(paper.METHOD):.0f} %."
    if not rate(method):
        # Who does not get anywhere presses less.
        return
    for figure, unit, words in (("time", "s", "is faster"), ("max_contact_force", "N", "presses less")):
        ratio = results.ratio(scene, goal, method, paper.METHOD, figure)
        if ratio is None or not _surely_below(ratio):
            continue
        theirs = results.summary(scene, goal, method, figure)
        ours = results.summary(scene, goal, paper.METHOD, figure)
        if ours.mean - theirs.mean < _NOTICEABLE[figure]:
            continue
        yield f"{method} {words}: {plus_minus(theirs)} against {plus_minus(ours)} {unit}."


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


def _latencies(report: Report) -> Iterator[str]:
    methods = report["grid"]["methods"]
    measured = any(entry["plans"] for scene in report["latencies"].values() for entry in scene.values())
    yield (
        "Latency of the episodes, ms: the median over plans of closed-loop runs that were measured beforehand, rounded "
        "up. Where the CPU plans it is the processor's time, which does not count what other programs take."
        if measured
        else "Latency of the episodes, ms, as given on the command line; it was not measured."
    )
    yield ""
    latencies = report["latencies"]
    rows = (
        [scene, *(f"{1e3 * latencies[scene][method]['latency_s']:.0f}" for method in methods)]
        for scene in report["grid"]["scenes"]
    )
    yield table(["scene", *methods], rows)
    yield ""
    published = paper.WALL_PLANNING_TIME
    wall = report["latencies"].get("wall", {})
    text = ", ".join(f"{1e3 * seconds:.0f} ms ({name})" for name, seconds in published.items())
    yield f"The paper, with walls: {text}: a ratio of {published[paper.JOINT_TORQUE] / published[paper.METHOD]:.2f}."
    medians = [wall.get(name, {}).get("cpu_median_s") for name in (paper.JOINT_TORQUE, paper.METHOD)]
    if all(medians):
        yield f"Here: {medians[0] / medians[1]:.2f}."
    yield ""
    for method in methods:
        yield f"- {method}: {METHODS.get(method, 'unknown to this version')}"


def _pictures(folder: Path) -> Iterator[str]:
    shown = [(name, text) for name, text in _PICTURES.items() if (folder / name).is_file()]
    if shown:
        yield "## Pictures"
        yield ""
    for name, text in shown:
        yield f"![{text}]({name})"
        yield ""


def _s(count: int) -> str:
    return "s" if count != 1 else ""
