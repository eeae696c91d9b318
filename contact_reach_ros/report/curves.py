"""The curves of a report's charts, as plotly takes them."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.signals import Series
from contact_reach_ros.drawing.palette import JOINT_COLOURS
from contact_reach_ros.report.bag import ReportBag
from contact_reach_ros.report.envelope import envelope
from contact_reach_ros.units import NANOSECONDS

Chart = dict[str, Any]
"""`data` and `layout` of a plotly figure; `linked` where its x axis is the time of the page.

Such axes show the times from `from` to `to` at first.
"""
Trace = dict[str, Any]

_GAP = 0.05
"""Time without messages that breaks a curve, s, at least."""


def packed(values: Any) -> dict[str, str]:
    """Numbers in single precision, in plotly's encoding."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()}


def curve(time: Array, values: Array, name: str, colour: str, unit: str, **more: Any) -> Trace:
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
    wide = np.flatnonzero(gaps(time))
    return np.insert(time, wide + 1, time[wide]), np.insert(values, wide + 1, np.nan)


def gaps(time: Array) -> NDArray[np.bool_]:
    """(n - 1,) whether messages are missing in a step between times (n,)."""
    steps = np.diff(time)
    return steps > max(20 * float(np.median(steps)), _GAP) if len(steps) else np.zeros(0, bool)


def level(value: float, name: str, colour: str, span: tuple[float, float], **more: Any) -> Trace:
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


def joint_curves(bag: ReportBag, series: Series, unit: str) -> list[Trace]:
    """One curve for each joint; none without any value."""
    if not len(series.time) or np.isnan(series.values).all():
        return []
    time = series.time - bag.zero
    return [
        curve(time, values, f"A{joint + 1}", _colour(joint), unit, _legendgroup=f"A{joint + 1}")
        for joint, values in enumerate(series.values.T)
    ]


def reexecuted_curves(bag: ReportBag, node: str) -> list[Trace]:
    """The same by re-execution with other settings, as second curves."""
    found = bag.reexecuted.get(node)
    if found is None:
        return []
    time = (found.stamp_ns - bag.signals.origin_ns) / NANOSECONDS - bag.zero
    return [
        curve(
            time,
            values,
            f"A{joint + 1} with other settings",
            _colour(joint),
            "Nm",
            dash="dot",
            _legendgroup=f"A{joint + 1}",
        )
        for joint, values in enumerate(found.values.T)
    ]


def limits(bag: ReportBag, lower: ArrayLike, upper: ArrayLike, name: str) -> list[Trace]:
    """Both limits (n,) of each joint, shown and hidden with its curve."""
    times = span(bag)
    return [
        level(
            limit,
            f"A{joint + 1} {name}, {abs(limit):.3g}",
            _colour(joint),
            times,
            legendgroup=f"A{joint + 1}",
            showlegend=False,
            opacity=0.7,
        )
        for joint, pair in enumerate(np.stack([lower, upper], axis=1).tolist())
        for limit in pair
    ]


def _colour(joint: int) -> str:
    return JOINT_COLOURS[joint % len(JOINT_COLOURS)]


def span(bag: ReportBag) -> tuple[float, float]:
    """First and last time of joint states, external torques and contact forces, s on the page."""
    times = [
        series.time
        for series in (bag.signals.position, bag.signals.external_torque, bag.signals.contact_force)
        if len(series.time)
    ]
    if not times:
        return (0.0, 1.0)
    return (float(min(time[0] for time in times)) - bag.zero, float(max(time[-1] for time in times)) - bag.zero)
