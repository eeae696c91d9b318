"""The picture of an episode: distance to the goal, contact force and external torque over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from contact_reach_ros.bags.signals import Series
from contact_reach_ros.drawing.palette import BLACK, BLUE, GREEN, GREY, JOINT_COLOURS, ORANGE, VERMILION
from contact_reach_ros.errors import BagError

SUCCESS_DISTANCE = 0.01
"""The paper's delta, m: the goal is reached within it."""

_DOTS = (0, (1, 3))
_MARKER_STYLES: dict[str, dict[str, Any]] = {
    "goal": {"color": BLUE, "linestyle": "-"},
    "reached": {"color": GREEN, "linestyle": "--"},
    "safety": {"color": VERMILION, "linestyle": ":"},
}
_NAMED = 8
"""Number of markers that the legend has room for."""
_SHORTEST = 1e-3
BEFORE = 2.0
"""Time shown before the first goal or stop, s: a stack may have waited long for its goal."""


@dataclasses.dataclass(frozen=True)
class Marker:
    """A moment to mark: time in s, a label of a few words, and a kind: "goal", "reached" or "safety"."""

    time: float
    label: str
    kind: str


def episode_figure(
    distance: Series,
    contact: Series,
    torque: Series,
    markers: Sequence[Marker],
    title: str,
    permitted_force: float,
    torque_thresholds: Sequence[float] = (),
) -> Figure:
    """Draw an episode in three panels: distance to the goal, contact force, external torque.

    Raises `BagError` if there is nothing to draw.

    Parameters
    ----------
    distance, contact, torque :
        Column "distance" from flange to goal, m; columns "max" and "sum" of the forces on the links, N; a column for
        each joint, Nm. All on one clock; the panel of an empty series stays empty.
    markers :
        Moments to mark; the earliest of kind "goal" becomes time zero.
    title :
        One line: scene, seed, result.
    permitted_force :
        The paper's epsilon, N.
    torque_thresholds :
        External torque of each joint above which the robot stops, Nm; empty to draw none.
    """
    times = (distance.time, contact.time, torque.time)
    recorded = [time for time in times if len(time)]
    if not recorded:
        raise BagError("nothing to plot: there is neither a distance, nor a contact force, nor an external torque")
    first, last = min(float(time.min()) for time in recorded), max(float(time.max()) for time in recorded)
    sent = [marker.time for marker in markers if marker.kind == "goal"]
    zero = min(sent, default=first)
    figure = Figure(figsize=(9.0, 7.6), dpi=130)
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 1.25)})
    _draw_distance(panels[0], distance.time - zero, distance.column("distance"))
    _draw_contact(panels[1], contact, zero, permitted_force)
    _draw_torque(panels[2], torque, zero, torque_thresholds)
    _draw_markers(panels, markers, zero)
    for panel, time in zip(panels, times, strict=True):
        _finish(panel, bool(len(time)))
    begin = max(first, min((marker.time for marker in markers), default=first) - BEFORE)
    panels[0].set_xlim(begin - zero, max(last, begin + _SHORTEST) - zero)
    panels[2].set_xlabel("time since the goal was sent [s]" if sent else "time [s]")
    figure.subplots_adjust(left=0.09, right=0.76, top=0.93, bottom=0.075, hspace=0.12)
    figure.suptitle(title, x=0.09, y=0.98, ha="left", fontsize=12, fontweight="bold")
    figure.align_ylabels(panels)
    return figure


def _draw_distance(panel: Axes, time: np.ndarray, distance: np.ndarray) -> None:
    panel.plot(time, distance, color=BLUE, linewidth=1.8, label="distance")
    label = f"success, {SUCCESS_DISTANCE:g} m"
    panel.axhline(SUCCESS_DISTANCE, color=GREY, linewidth=1.0, linestyle="--", label=label)
    panel.set_ylabel("distance to goal [m]")
    panel.set_yscale("log")
    positive = distance[distance > 0.0]
    low = min(SUCCESS_DISTANCE, positive.min(initial=np.inf))
    high = max(SUCCESS_DISTANCE, positive.max()) if len(positive) else 10 * SUCCESS_DISTANCE
    panel.set_ylim(low / 2, high * 2)
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_contact(panel: Axes, force: Series, zero: float, permitted: float) -> None:
    time = force.time - zero
    panel.plot(time, force.column("sum"), color=ORANGE, linewidth=1.4, label="sum of all bodies")
    panel.plot(time, force.column("max"), color=BLACK, linewidth=1.4, label="largest of any body")
    panel.axhline(permitted, color=VERMILION, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    panel.set_ylabel("contact force [N]")
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.set_ylim(0.0, 1.15 * max(permitted, np.nanmax(force.column("sum"), initial=0.0)))


def _draw_torque(panel: Axes, torque: Series, zero: float, thresholds: Sequence[float]) -> None:
    for joint, name in enumerate(torque.names):
        colour = JOINT_COLOURS[joint % len(JOINT_COLOURS)]
        panel.plot(torque.time - zero, torque.values[:, joint], color=colour, linewidth=1.2, label=name)
    panel.set_ylabel("external torque [Nm]")
    largest = float(np.nanmax(np.abs(torque.values), initial=0.0))
    for joint, threshold in enumerate(thresholds):
        colour = JOINT_COLOURS[joint % len(JOINT_COLOURS)]
        for value in (-threshold, threshold):
            panel.axhline(value, color=colour, linewidth=0.9, linestyle=_DOTS, alpha=0.7)
    if len(thresholds):
        panel.plot([], [], color=GREY, linewidth=0.9, linestyle=_DOTS, label="stop thresholds")
        # The nearest threshold stays in view; thresholds far above would flatten the curves.
        largest = max(largest, min(thresholds))
    panel.set_ylim(-1.15 * (largest or 1.0), 1.15 * (largest or 1.0))


def _finish(panel: Axes, recorded: bool) -> None:
    if not recorded:
        panel.text(0.5, 0.5, "not recorded", transform=panel.transAxes, ha="center", color=GREY)
    panel.grid(True, color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, borderaxespad=0.0)


def _draw_markers(panels: Sequence[Axes], markers: Sequence[Marker], zero: float) -> None:
    """Draw a line for each moment through all panels; the legend of the first one names them."""
    for marker in sorted(markers, key=lambda marker: marker.time):
        time, style = marker.time - zero, _MARKER_STYLES[marker.kind]
        for panel in panels:
            panel.axvline(time, linewidth=1.1, zorder=1.5, **style)
    for marker in sorted(markers, key=lambda marker: marker.time)[:_NAMED]:
        panels[0].plot(
            [], [], linewidth=1.1, label=f"{marker.label}, {marker.time - zero:.2f} s", **_MARKER_STYLES[marker.kind]
        )
