"""The quantities that the page plots over time, and their plots."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from contact_reach_ros.arm import Array
from contact_reach_ros.palette import BLUE, JOINT_COLOURS, VERMILION

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
        """The history: (n, `quantities`), with time 0 now."""
        table = np.array(self._rows, float).reshape(-1, 1 + len(self._columns))
        table[:, 0] -= table[-1:, 0]
        return table


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
        self._permitted = permitted_force
        torques = {name: {"stroke": colour} for name, colour in zip(joint_names, itertools.cycle(JOINT_COLOURS))}
        permitted = {"stroke": VERMILION, "dash": (6, 4)}
        self._handles = [
            _add(server, "Distance to the goal", "mm", {"flange": {"stroke": BLUE}}),
            _add(server, "Largest contact force", "N", {"on one link": {"stroke": BLUE}, "permitted": permitted}),
            _add(server, "External torque", "Nm", torques),
        ]

    def show(self, table: Array) -> None:
        """Show a table with the columns `quantities`."""
        time, distance, force, *torques = (np.ascontiguousarray(column) for column in table.T)
        permitted = np.full(len(time), self._permitted)
        for handle, curves in zip(self._handles, ([distance], [force, permitted], torques), strict=True):
            scales = _scales(curves)
            if scales != handle.scales:
                handle.scales = scales
            handle.data = (time, *curves)


def _add(server: viser.ViserServer, title: str, unit: str, curves: Mapping[str, Mapping[str, Any]]) -> Any:
    """Add an empty plot of curves with their options by label."""
    series: Any = ({"label": "time"}, *({"label": label, "width": 2, **curve} for label, curve in curves.items()))
    axes: Any = ({**_AXIS, "label": "s"}, {**_AXIS, "label": unit, "size": 46, "labelSize": 16})
    return server.gui.add_uplot(
        (np.zeros(0),) * len(series),
        series,
        title=f"{title} ({unit})",
        axes=axes,
        scales=_scales(()),
        legend={"show": len(series) > 2, "live": False},
        height=_HEIGHT,
        padding=(10, 14, 0, 0),
    )


def _scales(curves: Sequence[Array]) -> Any:
    """Scales that include all values: the browser's own choice fails if a curve begins with NaN."""
    values = np.concatenate([*curves, [0.0]])
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    if low == high:
        high = 1.0
    return {"x": {"time": False}, "y": {"range": (-_round_up(-low), _round_up(high))}}


def _round_up(value: float) -> float:
    """The next larger power of the square root of 2, so that an axis seldom changes; 0 for 0."""
    return float(2.0 ** (np.ceil(2.0 * np.log2(0.999 * value)) / 2.0)) if value > 0.0 else 0.0
