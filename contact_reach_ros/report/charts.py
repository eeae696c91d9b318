"""The charts of a report, as plotly figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from contact_reach_ros.bags.signals import Series
from contact_reach_ros.drawing.palette import BLACK, BLUE, GREEN, GREY, JOINT_COLOURS, ORANGE, VERMILION
from contact_reach_ros.report.bag import ReportBag, stop_reasons, threshold_share
from contact_reach_ros.report.curves import (
    Chart,
    Trace,
    curve,
    gaps,
    joint_curves,
    level,
    limits,
    packed,
    reexecuted_curves,
    span,
)
from contact_reach_ros.report.histogram import histogram
from contact_reach_ros.report.plot import SUCCESS_DISTANCE
from contact_reach_ros.report.spectrum import VIBRATION, band_rms, spectrum

TIME = "time since the goal [s]"
_MAXIMUM_LINES = 60
_EVENT_COLOURS = {0: GREY, 1: ORANGE, 2: VERMILION, 3: VERMILION}
_REASON_COLOURS = {"stagnated": BLUE, "max_steps": ORANGE, "deadline": VERMILION}


def distance_chart(bag: ReportBag) -> Chart:
    """Distance of the flange from the goal."""
    if bag.episode is None:
        return _chart(bag, [], "distance to the goal [m]")
    distance = bag.episode.distance
    data = [
        curve(distance.time - bag.zero, distance.column("distance"), "distance", BLUE, "m", width=1.8),
        level(SUCCESS_DISTANCE, f"reached, {SUCCESS_DISTANCE:g} m", GREEN, span(bag)),
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
        colour = JOINT_COLOURS[1 + index % (len(JOINT_COLOURS) - 1)]
        data.append(curve(time, force.column(name), name, colour, "N", width=1.0, _visible="legendonly"))
    permitted = bag.budget.permitted_force
    data.append(level(permitted, f"permitted, {permitted:g} N", VERMILION, span(bag)))
    top = 1.15 * max(permitted, float(np.nanmax(force.column("sum"), initial=0.0)))
    return _chart(bag, data, "contact force [N]", yaxis={"range": [0.0, top]})


def external_torque_chart(bag: ReportBag) -> Chart:
    """External torque of each joint against what stops the arm at rest."""
    torque = bag.signals.external_torque
    thresholds = np.array(bag.budget.torque_thresholds)
    data = joint_curves(bag, torque, "Nm")
    if not data:
        return _chart(bag, [], "external torque [Nm]")
    data += reexecuted_curves(bag, "observer")
    largest = float(np.nanmax(np.abs(torque.values), initial=0.0))
    # The nearest threshold stays in view; those far above must not flatten the curves.
    shown = 1.15 * max(largest, float(thresholds.min()))
    data += limits(bag, -thresholds, thresholds, "stops the arm")
    return _chart(bag, data, "external torque [Nm]", yaxis={"range": [-shown, shown]})


def threshold_chart(bag: ReportBag) -> Chart:
    """Greatest share of the external torque in what stops the arm at the speed of the joint."""
    share = threshold_share(bag)
    time = bag.signals.external_torque.time - bag.zero
    data = [curve(time, 100 * share, "nearest joint", BLUE, "%", width=1.6)] if len(share) else []
    if data:
        data.append(level(100.0, "stops the arm", VERMILION, span(bag)))
    return _chart(bag, data, "of the stop threshold [%]", yaxis={"rangemode": "tozero"})


def command_chart(bag: ReportBag) -> Chart:
    """Commanded torque of each joint against its cap."""
    command = bag.signals.command
    data = joint_curves(bag, command, "Nm")
    if not data:
        return _chart(bag, [], "commanded torque [Nm]")
    data += reexecuted_curves(bag, "controller")
    largest = 1.15 * float(np.nanmax(np.abs(command.values), initial=1.0))
    data += limits(bag, -bag.torque_limits, bag.torque_limits, "limit")
    return _chart(bag, data, "commanded torque [Nm]", yaxis={"range": [-largest, largest]})


def command_share_chart(bag: ReportBag) -> Chart:
    """Share of each commanded torque in its cap."""
    command = bag.signals.command
    shares = Series(command.time, command.names, 100 * np.abs(command.values) / bag.torque_limits)
    data = joint_curves(bag, shares, "%")
    if data:
        data.append(level(100.0, "limit", VERMILION, span(bag)))
    return _chart(bag, data, "of the torque limit [%]", yaxis={"range": [0.0, 110.0]})


def spectrum_chart(bag: ReportBag) -> Chart:
    """Spectrum of each joint's commanded torque from the goal to its end."""
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": "frequency [Hz]"}, "type": "log"},
        "yaxis": {"title": {"text": "commanded torque [Nm/√Hz]"}, "type": "log", "exponentformat": "power"},
    }
    command = bag.signals.command.between(bag.zero, bag.end)
    frequency, density = spectrum(command.time, command.values)
    if len(frequency) < 2:
        return {"data": [], "layout": layout, "missing": "not recorded in this bag"}
    data = [
        curve(frequency[1:], np.sqrt(joint[1:]), f"A{index + 1}", JOINT_COLOURS[index % len(JOINT_COLOURS)], "Nm/√Hz")
        for index, joint in enumerate(density.T)
    ]
    above = band_rms(frequency, density, VIBRATION)
    joints = ", ".join(f"A{index + 1} {rms:.2f}" for index, rms in enumerate(above))
    note = f"above {VIBRATION:g} Hz: {joints} Nm rms"
    return {"data": data, "layout": layout, "note": note}


def joint_chart(bag: ReportBag) -> Chart:
    """Joint angles against their limits."""
    data = joint_curves(bag, bag.signals.position, "rad")
    lower, upper = bag.arm.lower, bag.arm.upper
    data += limits(bag, lower, upper, "limit") if data else []
    margin = 0.05 * float(upper.max() - lower.min())
    return _chart(
        bag, data, "joint angle [rad]", yaxis={"range": [float(lower.min()) - margin, float(upper.max()) + margin]}
    )


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
            label, colour = (
                name.removeprefix("cost ").replace("_", " "),
                JOINT_COLOURS[1 + index % (len(JOINT_COLOURS) - 1)],
            )
            dash = "solid" if index < len(JOINT_COLOURS) - 1 else "dash"
            data.append(curve(time, cost, label, colour, "", dash=dash))
    return _chart(bag, data, "cost of a plan [1]")


def jitter_chart(bag: ReportBag) -> Chart:
    """How far each tick was from 1 ms after the one before."""
    return histogram(bag.jitter_us(), "deviation of a tick from 1 ms [µs]", BLUE)


def round_trip_chart(bag: ReportBag) -> Chart:
    """From joint state to command."""
    return histogram(bag.round_trip_us(), "joint state to command [µs]", GREEN)


def difference_chart(first: Series, second: Series, title: str, unit: str) -> Chart:
    """First series less the second one over the time that both have, by names."""
    data: list[Trace] = []
    names = [name for name in first.names if name in second.names]
    if len(first.time) < 2 or len(second.time) < 2:
        names = []
    for index, name in enumerate(names):
        known = np.isfinite(second.column(name))
        if not known.any():
            continue
        shared = first.time[(first.time >= second.time[0]) & (first.time <= second.time[-1])]
        others = np.interp(shared, second.time[known], second.column(name)[known])
        # Not across gaps of the other bag.
        before = np.clip(np.searchsorted(second.time, shared) - 1, 0, len(second.time) - 2)
        others[gaps(second.time)[before]] = np.nan
        change = np.interp(shared, first.time, first.column(name)) - others
        data.append(curve(shared, change, name, JOINT_COLOURS[(index + (len(names) == 1)) % len(JOINT_COLOURS)], unit))
    return {"data": data, "layout": _layout(title), "linked": True}


def _chart(bag: ReportBag, data: list[Trace], title: str, yaxis: dict[str, Any] | None = None) -> Chart:
    layout = _layout(title, yaxis)
    if not data:
        return {"data": [], "layout": layout, "missing": "not recorded in this bag"}
    _mark_events(bag, data, layout)
    return {"data": data, "layout": layout, "linked": True, "from": bag.shown_from, "to": span(bag)[1]}


def _layout(title: str, yaxis: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"xaxis": {"title": {"text": TIME}}, "yaxis": {"title": {"text": title}, **(yaxis or {})}}


def _mark_events(bag: ReportBag, data: list[Trace], layout: dict[str, Any]) -> None:
    """Safety events, the goal and its end on the time axis: lines, and points with their texts."""
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
