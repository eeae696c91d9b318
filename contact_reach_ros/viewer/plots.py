"""The curves of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from contact_reach_ros.palette import BLUE, GREEN, ORANGE, PURPLE, SKY_BLUE, VERMILION
from contact_reach_ros.viewer.history import JOINTS, QUANTITIES

Array = NDArray[np.float64]

LIVE_AXIS = "s, 0 is now"
BAG_AXIS = "s since the first joint state"

_MIDDLE_GREY = "#888888"
"""To be told from a light and from a dark ground."""
_HEIGHT = 165
_STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0)


class _Curve(NamedTuple):
    quantity: str
    label: str
    colour: str


class _Plot(NamedTuple):
    title: str
    unit: str
    curves: tuple[_Curve, ...]


_COLOURS = (ORANGE, SKY_BLUE, GREEN, BLUE, VERMILION, PURPLE, _MIDDLE_GREY)
_PLOTS = (
    _Plot("Distance to the goal", "mm", (_Curve("distance", "flange", BLUE),)),
    _Plot("Largest contact force", "N", (_Curve("force", "on one link", BLUE),)),
    _Plot("External torque", "Nm", tuple(map(_Curve, JOINTS, JOINTS, _COLOURS))),
    _Plot("Age of the plan", "ms", (_Curve("plan age", "since it took effect", BLUE),)),
    _Plot(
        "Round trip of a tick",
        "µs",
        (_Curve("round trip p50", "median", BLUE), _Curve("round trip p99", "99 of 100 below", ORANGE)),
    ),
)


class Plots:
    """One plot below the other, in the container that is open when it is made.

    Parameters
    ----------
    server
        Of the page.
    permitted_force
        Drawn as a line among the contact forces, N.
    """

    def __init__(self, server: viser.ViserServer, permitted_force: float) -> None:
        self._permitted = permitted_force
        self._axis = LIVE_AXIS
        self._handles = [self._add(server, plot) for plot in _PLOTS]

    def show(self, table: Array, axis: str) -> None:
        """Show a table as `History.table` makes it, its times as they are to be shown."""
        columns = dict(zip(("time", *QUANTITIES), table.T, strict=True))
        for plot, handle in zip(_PLOTS, self._handles, strict=True):
            if axis != self._axis:
                handle.axes = _axes(axis, plot.unit)
            data = self._data(plot, columns)
            scales = _scales(data[1:])
            if scales != handle.scales:
                handle.scales = scales
            handle.data = data
        self._axis = axis

    def _add(self, server: viser.ViserServer, plot: _Plot) -> Any:
        empty = dict.fromkeys(("time", *QUANTITIES), np.zeros(0))
        series: list[Any] = [{"label": "time"}]
        series += [{"label": curve.label, "stroke": curve.colour, "width": 2} for curve in plot.curves]
        if plot.unit == "N":
            series.append({"label": "permitted", "stroke": VERMILION, "width": 2, "dash": (6, 4)})
        return server.gui.add_uplot(
            self._data(plot, empty),
            tuple(series),
            title=f"{plot.title} ({plot.unit})",
            axes=_axes(self._axis, plot.unit),
            scales=_scales(()),
            legend={"show": len(series) > 2, "live": False},
            height=_HEIGHT,
            padding=(10, 14, 0, 0),
        )

    def _data(self, plot: _Plot, columns: dict[str, Array]) -> tuple[Array, ...]:
        data = [np.ascontiguousarray(columns["time"])]
        data += [np.ascontiguousarray(columns[curve.quantity]) for curve in plot.curves]
        if plot.unit == "N":
            data.append(np.full(len(data[0]), self._permitted))
        return tuple(data)


def _scales(curves: Sequence[Array]) -> Any:
    """Scales that hold all values: the browser's own choice fails where a curve begins with a gap, a NaN here."""
    values = np.concatenate([*curves, [0.0]])
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    if low == high:
        high = 1.0
    return {"x": {"time": False}, "y": {"range": (-_round_up(-low), _round_up(high))}}


def _round_up(value: float) -> float:
    """The next larger number that makes a good end of an axis; 0 for 0."""
    if value <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in _STEPS if step * power >= 0.999 * value))


def _axes(time: str, unit: str) -> Any:
    plain = {"size": 28, "labelSize": 18, "labelFont": "12px system-ui", "font": "11px system-ui", "gap": 2}
    return ({**plain, "label": time}, {**plain, "label": unit, "size": 46, "labelSize": 16})
