"""The quantities that the page plots over time, and their plots."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.drawing.palette import BLUE, JOINT_COLOURS, VERMILION

SPAN = 20.0
"""Time span of a plot, s."""
_HEIGHT = 165
_AXIS: dict[str, Any] = {
    "size": 28,
    "labelSize": 18,
    "labelFont": "12px system-ui",
    "font": "11px system-ui",
    "gap": 2,
}
_STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0)


def quantities(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Columns of the plotted tables.

    Time, s; distance to the goal, mm; largest contact force on one link, N; external torque of each joint, Nm.
    """
    return ("time", "distance", "force", *joint_names)


class History:
    """Plotted quantities over the last `SPAN` seconds."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._columns = quantities(joint_names)[1:]
        self._rows: deque[tuple[float, ...]] = deque()

    def add(self, time: float, values: Mapping[str, float]) -> None:
        """Append the quantities known at a time, s, by name; a time before the last one clears the history."""
        if self._rows and time < self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time, *(values.get(name, np.nan) for name in self._columns)))
        while self._rows[0][0] < time - SPAN:
            self._rows.popleft()

    def table(self) -> Array:
        """The history: (n, `quantities`)."""
        return np.array(self._rows, float).reshape(-1, 1 + len(self._columns))


class Curve(NamedTuple):
    """A quantity of the plotted tables."""

    quantity: str
    label: str
    colour: str


class Plot(NamedTuple):
    """Curves over the same time with the same unit."""

    title: str
    unit: str
    curves: tuple[Curve, ...]


def page_plots(joint_names: Sequence[str]) -> tuple[Plot, ...]:
    """The plots of the page for an arm with these joints."""
    return (
        Plot("Distance to the goal", "mm", (Curve("distance", "flange", BLUE),)),
        Plot("Largest contact force", "N", (Curve("force", "on one link", BLUE),)),
        Plot("External torque", "Nm", tuple(map(Curve, joint_names, joint_names, itertools.cycle(JOINT_COLOURS)))),
    )


class Plots:
    """Plots, one below the other, in the GUI container that is open at construction.

    Parameters
    ----------
    server
        Server of the page.
    joint_names
        Names of the arm's joints.
    permitted_force
        Force that a line marks among the contact forces, N.
    """

    def __init__(self, server: viser.ViserServer, joint_names: Sequence[str], permitted_force: float) -> None:
        self._columns, self._plots = quantities(joint_names), page_plots(joint_names)
        self._permitted = permitted_force
        self._handles = [self._add(server, plot) for plot in self._plots]

    def show(self, table: Array) -> None:
        """Show a table with the columns `quantities`."""
        columns = dict(zip(self._columns, table.T, strict=True))
        for plot, handle in zip(self._plots, self._handles, strict=True):
            data = self._data(plot, columns)
            scales = _scales(data[1:])
            if scales != handle.scales:
                handle.scales = scales
            handle.data = data

    def _add(self, server: viser.ViserServer, plot: Plot) -> Any:
        empty = dict.fromkeys(self._columns, np.zeros(0))
        series: list[Any] = [{"label": "time"}]
        series += [{"label": curve.label, "stroke": curve.colour, "width": 2} for curve in plot.curves]
        if plot.unit == "N":
            series.append({"label": "permitted", "stroke": VERMILION, "width": 2, "dash": (6, 4)})
        axes: Any = ({**_AXIS, "label": "s"}, {**_AXIS, "label": plot.unit, "size": 46, "labelSize": 16})
        return server.gui.add_uplot(
            self._data(plot, empty),
            tuple(series),
            title=f"{plot.title} ({plot.unit})",
            axes=axes,
            scales=_scales(()),
            legend={"show": len(series) > 2, "live": False},
            height=_HEIGHT,
            padding=(10, 14, 0, 0),
        )

    def _data(self, plot: Plot, columns: dict[str, Array]) -> tuple[Array, ...]:
        data = [np.ascontiguousarray(columns["time"])]
        data += [np.ascontiguousarray(columns[curve.quantity]) for curve in plot.curves]
        if plot.unit == "N":
            data.append(np.full(len(data[0]), self._permitted))
        return tuple(data)


def _scales(curves: Sequence[Array]) -> Any:
    """Scales that include all values: the browser's own choice fails if a curve begins with NaN."""
    values = np.concatenate([*curves, [0.0]])
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    if low == high:
        high = 1.0
    return {"x": {"time": False}, "y": {"range": (-_round_up(-low), _round_up(high))}}


def _round_up(value: float) -> float:
    """The next larger number suitable for the end of an axis; 0 for 0."""
    if value <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in _STEPS if step * power >= 0.999 * value))
