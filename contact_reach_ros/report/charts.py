"""The charts of a report, as plotly figures."""

from __future__ import annotations

import base64
from collections import Counter
from typing import Any

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.bags.signals import Series
from contact_reach_ros.palette import BLACK, BLUE, GREEN, GREY, JOINT_COLOURS, ORANGE, VERMILION
from contact_reach_ros.report.bag import ReportBag, largest
from contact_reach_ros.world.goal import TOLERANCE

Chart = dict[str, Any]
"""`data` and `layout` of a plotly figure; empty data if the bag lacks the quantity.

The x axis is the page's time; charts show the times from `from` to `to` at first.
"""
Trace = dict[str, Any]

BINS = 1500
"""Number of bins that a long curve is cut into, about one per column of a screen."""
_GAP = 0.05
"""Shortest time without messages that interrupts a curve, s."""
_MAXIMUM_LINES = 60
_EVENT_COLOURS = {0: GREY, 1: ORANGE, 2: VERMILION, 3: VERMILION}
_REASON_COLOURS = {"stagnated": BLUE, "max_steps": ORANGE, "deadline": VERMILION}


def distance_chart(bag: ReportBag) -> Chart:
    """Distance of the flange from the goal."""
    if not bag.has_goal:
        return _chart(bag, [], "distance to the goal [m]")
    distance = bag.distance
    data = [
        curve(distance.time - bag.zero, distance.column("distance"), "distance", BLUE, "m", width=1.8),
        _level(bag, TOLERANCE, f"tolerance, {TOLERANCE:g} m", GREEN),
    ]
    return _chart(bag, data, "distance to the goal [m]", type="log", dtick=1, exponentformat="none")


def contact_chart(bag: ReportBag) -> Chart:
    """Contact force on the links over time, as in the paper's Fig. 5, against the permitted force."""
    force = bag.signals.contact_force
    if not len(force.time):
        return _chart(bag, [], "contact force [N]")
    time = force.time - bag.zero
    data = [
        curve(time, force.column("sum"), "sum of all links", ORANGE, "N"),
        curve(time, force.column("max"), "largest of any link", BLACK, "N", width=1.8),
    ]
    for index, name in enumerate(name for name in force.names if name not in ("sum", "max")):
        link = curve(time, force.column(name), name, _other_colour(index), "N", width=1.0)
        data.append({**link, "visible": "legendonly"})
    permitted = bag.budget.permitted_force
    data.append(_level(bag, permitted, f"permitted, {permitted:g} N", VERMILION))
    top = 1.15 * float(np.fmax(permitted, largest(force.column("sum"))))
    return _chart(bag, data, "contact force [N]", range=[0.0, top])


def external_torque_chart(bag: ReportBag) -> Chart:
    """External torque of each joint against the threshold that stops the arm at rest."""
    thresholds = np.array(bag.budget.torque_thresholds)
    greatest = largest(np.abs(bag.signals.external_torque.values))
    # The nearest threshold stays in view; thresholds far above would flatten the curves.
    shown = 1.15 * float(np.fmax(thresholds.min(), greatest))
    data = _joint_curves(bag, bag.signals.external_torque, "Nm", -thresholds, thresholds, "stops the arm")
    return _chart(bag, data, "external torque [Nm]", range=[-shown, shown])


def command_chart(bag: ReportBag) -> Chart:
    """Commanded torque of each joint against its limit."""
    limits = bag.torque_limits
    shown = 1.15 * float(np.fmax(1.0, largest(np.abs(bag.signals.command.values))))
    data = _joint_curves(bag, bag.signals.command, "Nm", -limits, limits, "limit")
    return _chart(bag, data, "commanded torque [Nm]", range=[-shown, shown])


def joint_chart(bag: ReportBag) -> Chart:
    """Joint angles against their limits."""
    lower, upper = bag.arm.lower, bag.arm.upper
    margin = 0.05 * float(upper.max() - lower.min())
    data = _joint_curves(bag, bag.signals.position, "rad", lower, upper, "limit")
    shown = [float(lower.min()) - margin, float(upper.max()) + margin]
    return _chart(bag, data, "joint angle [rad]", range=shown)


def solve_chart(bag: ReportBag) -> Chart:
    """Solve time of each plan, coloured by the reason that ended the search."""
    time, took = bag.signals.plans.time - bag.zero, bag.signals.plans.column("took ms")
    reasons = np.array(bag.signals.stop_reasons)
    data = []
    for reason, count in sorted(Counter(bag.signals.stop_reasons).items()):
        chosen = reasons == reason
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": f"{reason} ({count})",
                "x": _packed(time[chosen]),
                "y": _packed(took[chosen]),
                "marker": {"color": _REASON_COLOURS.get(reason, GREY), "size": 5},
                "hovertemplate": f"%{{y:.1f}} ms at %{{x:.3f}} s<extra>{reason}</extra>",
            }
        )
    return _chart(bag, data, "solve time of a plan [ms]", rangemode="tozero")


def cost_chart(bag: ReportBag) -> Chart:
    """Cost of each plan, and its terms."""
    plans = bag.signals.plans
    time = plans.time - bag.zero
    costs = {name: plans.column(name) for name in plans.names if name == "cost" or name.startswith("cost ")}
    terms = [name for name, values in costs.items() if name != "cost" and np.nan_to_num(values).any()]
    data = [curve(time, costs["cost"], "sum", GREY, "", width=3.5)] if "cost" in costs else []
    for index, name in enumerate(terms):
        words = name.removeprefix("cost ").replace("_", " ")
        dash = "solid" if index < len(JOINT_COLOURS) - 1 else "dash"
        data.append(curve(time, costs[name], words, _other_colour(index), "", dash=dash))
    return _chart(bag, data, "cost of a plan [1]")


def curve(time: Array, values: Array, name: str, colour: str, unit: str, **line: Any) -> Trace:
    """A curve of values (n,) over time (n,), s, interrupted where messages are missing, thinned out if it is long.

    `line` are further properties of plotly's line.
    """
    steps = np.diff(time)
    wide = np.flatnonzero(steps > max(20 * float(np.median(steps)), _GAP)) if len(steps) else np.zeros(0, int)
    thinned_time, thinned = envelope(np.insert(time, wide + 1, time[wide]), np.insert(values, wide + 1, np.nan))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": _packed(thinned_time),
        "y": _packed(thinned),
        "line": {"color": colour, "width": 1.4, **line},
        "hovertemplate": f"%{{y:.4~g}} {unit} at %{{x:.3f}} s<extra>{name}</extra>",
    }


def envelope(time: Array, values: Array) -> tuple[Array, Array]:
    """The least and the greatest value of each bin, both at its beginning, so that no peak is lost.

    Parameters
    ----------
    time
        (n,).
    values
        (n,); NaN where there is none.

    Returns
    -------
    time, values
        Two samples per bin; a short curve as it is. A bin without any value is a gap.
    """
    if len(time) <= 2 * BINS:
        return time, values
    size = -(-len(time) // BINS)
    rows = np.append(values, np.full(-len(values) % size, np.nan)).reshape(-1, size)
    extremes = np.stack([np.fmin.reduce(rows, axis=1), np.fmax.reduce(rows, axis=1)], axis=1)
    return np.repeat(time[::size], 2), extremes.ravel()


def _packed(values: Array) -> dict[str, str]:
    """Numbers in single precision, in plotly's encoding."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()}


def _other_colour(index: int) -> str:
    """Colour of a series beside a grey or black one."""
    return JOINT_COLOURS[1 + index % (len(JOINT_COLOURS) - 1)]


def _joint_curves(bag: ReportBag, series: Series, unit: str, lower: Array, upper: Array, limit: str) -> list[Trace]:
    """A curve for each joint with its limits (n,), which are shown and hidden together; empty without any value."""
    if not len(series.time) or np.isnan(series.values).all():
        return []
    time = series.time - bag.zero
    curves, limits = [], []
    for joint, name in enumerate(series.names):
        colour = JOINT_COLOURS[joint % len(JOINT_COLOURS)]
        curves.append({**curve(time, series.values[:, joint], name, colour, unit), "legendgroup": name})
        for value in (float(lower[joint]), float(upper[joint])):
            line = _level(bag, value, f"{name} {limit}, {abs(value):.3g}", colour)
            limits.append({**line, "legendgroup": name, "showlegend": False, "opacity": 0.7})
    return [*curves, *limits]


def _level(bag: ReportBag, value: float, name: str, colour: str) -> Trace:
    """A horizontal line."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": list(_span(bag)),
        "y": [value, value],
        "line": {"color": colour, "width": 1.2, "dash": "dash"},
        "hoverinfo": "name",
    }


def _span(bag: ReportBag) -> tuple[float, float]:
    """First and last time of joint states, external torques and contact forces, s on the page."""
    signals = bag.signals
    recorded = (signals.position.time, signals.external_torque.time, signals.contact_force.time)
    times = [time for time in recorded if len(time)]
    if not times:
        return (0.0, 1.0)
    return (float(min(time[0] for time in times)) - bag.zero, float(max(time[-1] for time in times)) - bag.zero)


def _chart(bag: ReportBag, data: list[Trace], title: str, **yaxis: Any) -> Chart:
    """A chart over the page's time with the events marked; `yaxis` are further properties of plotly's y axis."""
    layout = {"xaxis": {"title": {"text": "time since the goal [s]"}}, "yaxis": {"title": {"text": title}, **yaxis}}
    if not data:
        return {"data": [], "layout": layout}
    _mark_events(bag, data, layout)
    return {"data": data, "layout": layout, "from": bag.shown_from, "to": _span(bag)[1]}


def _mark_events(bag: ReportBag, data: list[Trace], layout: dict[str, Any]) -> None:
    """Mark the goal, its end and the safety events on the time axis: lines, and points with their texts."""
    marks = [(0.0, BLUE, "goal sent")] if bag.has_goal else []
    if np.isfinite(bag.reached):
        marks.append((bag.reached - bag.zero, GREEN, "settled at the goal"))
    for event in bag.signals.safety:
        words = f"{event.name}: {event.message}"
        marks.append((event.time - bag.zero, _EVENT_COLOURS.get(event.level, GREY), words))
    # Stops first, in case there are too many lines to draw.
    important = sorted(marks, key=lambda mark: mark[1] == GREY)[:_MAXIMUM_LINES]
    layout["shapes"] = [
        {
            "type": "line",
            "x0": time,
            "x1": time,
            "yref": "paper",
            "y0": 0,
            "y1": 1,
            "line": {"color": colour, "width": 1, "dash": "dot"},
            "layer": "below",
        }
        for time, colour, _ in important
    ]
    data.append(
        {
            "type": "scatter",
            "mode": "markers",
            "name": "events",
            "x": [time for time, _, _ in marks],
            "y": [1.0] * len(marks),
            "yaxis": "y2",
            "marker": {"color": [colour for _, colour, _ in marks], "size": 8, "symbol": "triangle-down"},
            "text": [words for _, _, words in marks],
            "hovertemplate": "%{text}<br>%{x:.3f} s<extra></extra>",
            "showlegend": False,
            "cliponaxis": False,
        }
    )
    layout["yaxis2"] = {"overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True}
