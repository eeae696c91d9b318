"""The charts of a report, as plotly takes them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY_BLUE, VERMILION
from contact_reach_ros.recording.envelope import envelope
from contact_reach_ros.recording.plot import SUCCESS_DISTANCE
from contact_reach_ros.recording.report_bag import ReportBag, stop_reasons, threshold_share
from contact_reach_ros.recording.signals import Series
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.timing import PERCENTILES
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]
Chart = dict[str, Any]
"""`data` and `layout` of a plotly figure; `linked` where its x axis is the time of the page."""

COLOURS = (BLACK, ORANGE, SKY_BLUE, GREEN, PURPLE, BLUE, VERMILION)
"""Of the joints, and of whatever else there are several of."""

TIME = "time since the goal [s]"
_MAXIMUM_LINES = 60
_BARS = 60
_GAP = 0.05
"""s."""
_EVENT_COLOURS = {0: GREY, 1: ORANGE, 2: VERMILION, 3: VERMILION}
_REASON_COLOURS = {"stagnated": BLUE, "max_steps": ORANGE, "deadline": VERMILION}


def packed(values: Any) -> dict[str, str]:
    """Numbers in single precision, as plotly reads them from text."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()}


def curve(time: Array, values: Array, name: str, colour: str, unit: str, **more: Any) -> dict[str, Any]:
    """A curve over time, thinned out if it is long; `more` goes to the line, or to the trace where it begins with _."""
    thinned_time, thinned = envelope(*_with_gaps(time, values))
    trace = {key[1:]: value for key, value in more.items() if key.startswith("_")}
    line = {key: value for key, value in more.items() if not key.startswith("_")}
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": packed(thinned_time),
        "y": packed(thinned),
        "line": {"color": colour, "width": 1.4, **line},
        "hovertemplate": f"%{{y:.4~g}} {unit} at %{{x:.3f}} s<extra>{name}</extra>",
        **trace,
    }


def _with_gaps(time: Array, values: Array) -> tuple[Array, Array]:
    """The curve with a break where messages are missing."""
    wide = np.flatnonzero(_gaps(time))
    return np.insert(time, wide + 1, time[wide]), np.insert(values, wide + 1, np.nan)


def _gaps(time: Array) -> NDArray[np.bool_]:
    """(n - 1,) which steps are so long that nobody knows what happened meanwhile."""
    steps = np.diff(time)
    return steps > max(20 * float(np.median(steps)), _GAP) if len(steps) else np.zeros(0, bool)


def level(value: float, name: str, colour: str, span: tuple[float, float], **more: Any) -> dict[str, Any]:
    """A horizontal line."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": list(span),
        "y": [value, value],
        "line": {"color": colour, "width": 1.2, "dash": "dash"},
        "hoverinfo": "name",
        **more,
    }


def distance_chart(bag: ReportBag) -> Chart:
    """Distance of the flange from the goal."""
    if bag.episode is None:
        return _chart(bag, [], "distance to the goal [m]")
    time, distance = bag.episode.distance
    data = [
        curve(time - bag.zero, distance, "distance", BLUE, "m", width=1.8),
        level(SUCCESS_DISTANCE, f"reached, {SUCCESS_DISTANCE:g} m", GREEN, _span(bag)),
    ]
    return _chart(bag, data, "distance to the goal [m]", yaxis={"type": "log", "dtick": 1, "exponentformat": "none"})


def contact_chart(bag: ReportBag) -> Chart:
    """Contact force over time, as the paper's Fig. 5, against the permitted one."""
    force = bag.signals.contact_force
    if not len(force.time):
        return _chart(bag, [], "contact force [N]")
    time = force.time - bag.zero
    data = [
        curve(time, force.column("sum"), "sum of all links", ORANGE, "N"),
        curve(time, force.column("max"), "largest of any link", BLACK, "N", width=1.8),
    ]
    for index, name in enumerate(name for name in force.names if name not in ("sum", "max")):
        colour = COLOURS[1 + index % (len(COLOURS) - 1)]
        data.append(curve(time, force.column(name), name, colour, "N", width=1.0, _visible="legendonly"))
    permitted = bag.budget.permitted_force
    data.append(level(permitted, f"permitted, {permitted:g} N", VERMILION, _span(bag)))
    top = 1.15 * max(permitted, float(np.nanmax(force.column("sum"), initial=0.0)))
    return _chart(bag, data, "contact force [N]", yaxis={"range": [0.0, top]})


def external_torque_chart(bag: ReportBag) -> Chart:
    """External torque of each joint against what stops the arm at rest."""
    torque = bag.signals.external_torque
    thresholds = bag.budget.torque_thresholds
    data = _joint_curves(bag, torque, "Nm")
    if not data:
        return _chart(bag, [], "external torque [Nm]")
    data += _rerun_curves(bag, "observer")
    largest = float(np.nanmax(np.abs(torque.values), initial=0.0))
    # The nearest threshold stays in view; those far above must not flatten the curves.
    shown = 1.15 * max(largest, min(thresholds))
    data += _limits(bag, thresholds, "stops the arm")
    return _chart(bag, data, "external torque [Nm]", yaxis={"range": [-shown, shown]})


def threshold_chart(bag: ReportBag) -> Chart:
    """Greatest share of the external torque in what stops the arm at the speed of the joint."""
    share = threshold_share(bag)
    time = bag.signals.external_torque.time - bag.zero
    data = [curve(time, 100 * share, "nearest joint", BLUE, "%", width=1.6)] if len(share) else []
    if data:
        data.append(level(100.0, "stops the arm", VERMILION, _span(bag)))
    return _chart(bag, data, "of the stop threshold [%]", yaxis={"rangemode": "tozero"})


def command_chart(bag: ReportBag) -> Chart:
    """Commanded torque of each joint against its cap."""
    command = bag.signals.command
    data = _joint_curves(bag, command, "Nm")
    if not data:
        return _chart(bag, [], "commanded torque [Nm]")
    data += _rerun_curves(bag, "controller")
    largest = 1.15 * float(np.nanmax(np.abs(command.values), initial=1.0))
    data += _limits(bag, bag.torque_limits.tolist(), "limit")
    return _chart(bag, data, "commanded torque [Nm]", yaxis={"range": [-largest, largest]})


def command_share_chart(bag: ReportBag) -> Chart:
    """Share of each commanded torque in its cap."""
    command = bag.signals.command
    shares = Series(command.time, command.names, 100 * np.abs(command.values) / bag.torque_limits)
    data = _joint_curves(bag, shares, "%")
    if data:
        data.append(level(100.0, "limit", VERMILION, _span(bag)))
    return _chart(bag, data, "of the torque limit [%]", yaxis={"range": [0.0, 110.0]})


def joint_chart(bag: ReportBag) -> Chart:
    """Joint angles against their limits."""
    data = _joint_curves(bag, bag.signals.position, "rad")
    data += _limits(bag, iiwa14.POSITION_LIMITS, "limit") if data else []
    return _chart(bag, data, "joint angle [rad]", yaxis={"range": [-3.2, 3.2]})


def plan_age_chart(bag: ReportBag) -> Chart:
    """Age of the plan in force at each joint state."""
    time, effects = bag.signals.position.time, bag.signals.plan_times
    if not len(effects) or not len(time):
        return _chart(bag, [], "plan age [ms]")
    # Each plan at its oldest, when the next takes effect, or at the end of the recording.
    ends = np.minimum(np.append(effects[1:], time[-1]), time[-1])
    counts = ends > effects
    data = [
        curve(ends[counts] - bag.zero, 1000 * (ends - effects)[counts], "each plan at its oldest", BLUE, "ms"),
    ]
    return _chart(bag, data, "plan age [ms]", yaxis={"rangemode": "tozero"})


def solve_chart(bag: ReportBag) -> Chart:
    """Time that each plan took, by what ended the search."""
    plans = bag.signals.plans
    time = np.array([plan.time for plan in plans]) - bag.zero
    took = np.array([plan.numbers.get("took ms", np.nan) for plan in plans])
    data = []
    for reason, count in stop_reasons(bag).items():
        chosen = np.array([plan.stop_reason == reason for plan in plans])
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": f"{reason} ({count})",
                "x": packed(time[chosen]),
                "y": packed(took[chosen]),
                "marker": {"color": _REASON_COLOURS.get(reason, GREY), "size": 5},
                "hovertemplate": f"%{{y:.1f}} ms at %{{x:.3f}} s<extra>{reason}</extra>",
            }
        )
    return _chart(bag, data, "time of a plan [ms]", yaxis={"rangemode": "tozero"})


def cost_chart(bag: ReportBag) -> Chart:
    """Terms of each plan's cost."""
    plans = bag.signals.plans
    time = np.array([plan.time for plan in plans]) - bag.zero
    names = [name for name in (plans[0].numbers if plans else ()) if name == "cost" or name.startswith("cost ")]
    values = {name: np.array([plan.numbers.get(name, np.nan) for plan in plans]) for name in sorted(names)}
    data = []
    for name, cost in values.items():
        if name == "cost":
            data.append(curve(time, cost, "sum", GREY, "", width=3.5))
        elif np.nan_to_num(cost).any():
            index = len(data) - 1
            label, colour = name.removeprefix("cost ").replace("_", " "), COLOURS[1 + index % (len(COLOURS) - 1)]
            dash = "solid" if index < len(COLOURS) - 1 else "dash"
            data.append(curve(time, cost, label, colour, "", dash=dash))
    return _chart(bag, data, "cost of a plan [1]")


def jitter_chart(bag: ReportBag) -> Chart:
    """How far each tick was from 1 ms after the one before."""
    return _histogram(bag.jitter_us(), "deviation of a tick from 1 ms [µs]", BLUE)


def round_trip_chart(bag: ReportBag) -> Chart:
    """From joint state to command."""
    return _histogram(bag.round_trip_us(), "joint state to command [µs]", GREEN)


def difference_chart(series: Sequence[tuple[str, Array, Array, Array, Array]], title: str, unit: str) -> Chart:
    """First bag less second one over the time that both have; each entry a name with time and values of both."""
    data = []
    for index, (name, time, values, other_time, other_values) in enumerate(series):
        if len(time) < 2 or len(other_time) < 2:
            continue
        shared = time[(time >= other_time[0]) & (time <= other_time[-1])]
        known = np.isfinite(other_values)
        if not known.any():
            continue
        others = np.interp(shared, other_time[known], other_values[known])
        # Not across what the other bag has lost.
        before = np.clip(np.searchsorted(other_time, shared) - 1, 0, len(other_time) - 2)
        others[_gaps(other_time)[before]] = np.nan
        change = np.interp(shared, time, values) - others
        data.append(curve(shared, change, name, COLOURS[(index + (len(series) == 1)) % len(COLOURS)], unit))
    return {"data": data, "layout": _layout(title), "linked": True}


def _chart(bag: ReportBag, data: list[dict[str, Any]], title: str, yaxis: dict[str, Any] | None = None) -> Chart:
    layout = _layout(title, yaxis)
    if not data:
        return {"data": [], "layout": layout, "missing": "not recorded in this bag"}
    _mark_events(bag, data, layout)
    return {"data": data, "layout": layout, "linked": True}


def _layout(title: str, yaxis: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"xaxis": {"title": {"text": TIME}}, "yaxis": {"title": {"text": title}, **(yaxis or {})}}


def _mark_events(bag: ReportBag, data: list[dict[str, Any]], layout: dict[str, Any]) -> None:
    """Safety events, the goal and its end on the time axis: lines, and points that tell what they are."""
    marks = [(0.0, BLUE, "goal sent")] if bag.episode is not None else []
    if bag.episode is not None and bag.episode.reached is not None:
        marks.append((bag.episode.reached - bag.zero, GREEN, "goal reached"))
    for event in bag.signals.safety:
        words = f"{event.name}: {event.message}"
        marks.append((event.time - bag.zero, _EVENT_COLOURS.get(event.level, GREY), words))
    # Stops first, should there be too many lines to draw.
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


def _joint_curves(bag: ReportBag, series: Series, unit: str) -> list[dict[str, Any]]:
    if not len(series.time) or np.isnan(series.values).all():
        return []
    time = series.time - bag.zero
    return [
        curve(time, series.values[:, joint], f"A{joint + 1}", COLOURS[joint], unit, _legendgroup=f"A{joint + 1}")
        for joint in range(iiwa14.N_JOINTS)
    ]


def _rerun_curves(bag: ReportBag, node: str) -> list[dict[str, Any]]:
    """What other settings would have done, as second curves."""
    rerun = bag.reruns.get(node)
    if rerun is None:
        return []
    time = (rerun.stamp_ns - bag.signals.origin_ns) / NANOSECONDS - bag.zero
    return [
        curve(
            time,
            rerun.values[:, joint],
            f"A{joint + 1} with other settings",
            COLOURS[joint],
            "Nm",
            dash="dot",
            _legendgroup=f"A{joint + 1}",
        )
        for joint in range(iiwa14.N_JOINTS)
    ]


def _limits(bag: ReportBag, limits: Sequence[float], name: str) -> list[dict[str, Any]]:
    """Both limits of each joint, shown and hidden with its curve."""
    span = _span(bag)
    return [
        level(
            sign * limit,
            f"A{joint + 1} {name}, {limit:.3g}",
            COLOURS[joint],
            span,
            legendgroup=f"A{joint + 1}",
            showlegend=False,
            opacity=0.7,
        )
        for joint, limit in enumerate(limits)
        for sign in (-1.0, 1.0)
    ]


def _span(bag: ReportBag) -> tuple[float, float]:
    times = [
        series.time
        for series in (bag.signals.position, bag.signals.external_torque, bag.signals.contact_force)
        if len(series.time)
    ]
    if not times:
        return (0.0, 1.0)
    return (float(min(time[0] for time in times)) - bag.zero, float(max(time[-1] for time in times)) - bag.zero)


def _histogram(values: Array, title: str, colour: str) -> Chart:
    values = values[np.isfinite(values)]
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": title}},
        "yaxis": {"title": {"text": "number of ticks"}, "type": "log", "dtick": 1, "exponentformat": "none"},
        "bargap": 0.03,
    }
    if not len(values):
        return {"data": [], "layout": layout, "missing": "not recorded in this bag"}
    # All but the farthest thousandth side by side; those beyond share the outermost bars.
    low, high = np.percentile(values, (0.1, 99.9))
    margin = 0.1 * max(high - low, 1.0)
    edges = np.linspace(low - margin, high + margin, _BARS + 1)
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    centres = 0.5 * (edges[1:] + edges[:-1])
    data = [
        {
            "type": "bar",
            "x": packed(centres),
            "y": counts.tolist(),
            "marker": {"color": colour},
            "hovertemplate": "%{y} ticks near %{x:.0f} µs<extra></extra>",
            "showlegend": False,
        }
    ]
    shares = {name: float(np.percentile(values, PERCENTILES[name])) for name in ("p50", "p99", "p999")}
    words = ", ".join(f"p{PERCENTILES[name]:g} {round(value)}" for name, value in shares.items())
    note = f"{words}, least {values.min():.0f}, most {values.max():.0f} µs; what lies farther out is in the outer bars"
    return {"data": data, "layout": layout, "note": note}
