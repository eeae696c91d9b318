"""The picture of an episode: distance to the goal, contact force and external torque over time."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contact_reach_ros.errors import BagError
from contact_reach_ros.palette import BLUE, GREEN, GREY, VERMILION
from contact_reach_ros.report.bag import ReportBag
from contact_reach_ros.report.charts import Chart, contact_chart, distance_chart, external_torque_chart

_AFTER = 0.2
"""Shown after the end of the episode, s."""


def draw_episode(bag: ReportBag, title: str, file: Path) -> None:
    """Draw the episode of a bag in three panels with a common time axis, and write it as a PNG.

    Raises `BagError` if the file cannot be written.
    """
    figure = Figure(figsize=(9.0, 7.6), dpi=130)
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 1.25)})
    panels[2].plot([], [], color=GREY, linestyle="--", label="stop thresholds")
    for panel, make in zip(panels, (distance_chart, contact_chart, external_torque_chart), strict=True):
        _draw(panel, make(bag))
        _draw_moments(panel, bag, with_labels=panel is panels[0])
        panel.grid(True, color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, borderaxespad=0.0)
    panels[2].set_xlabel("time since the goal was sent [s]")
    if np.isfinite(bag.end):
        panels[2].set_xlim(bag.shown_from, bag.end - bag.zero + _AFTER)
    figure.subplots_adjust(left=0.09, right=0.76, top=0.93, bottom=0.075, hspace=0.12)
    figure.suptitle(title, x=0.09, y=0.98, ha="left", fontsize=12, fontweight="bold")
    figure.align_ylabels(panels)
    try:
        figure.savefig(file, format="png")
    except OSError as error:
        raise BagError(f"plot '{file}' cannot be written: {error.strerror}") from error


def _draw(panel: Axes, chart: Chart) -> None:
    """Draw the curves of a chart, without those that the page hides at first."""
    for trace in chart["data"]:
        if trace["mode"] == "lines" and trace.get("visible") != "legendonly":
            label, line = trace["name"] if trace.get("showlegend", True) else None, trace["line"]
            style = {"color": line["color"], "linewidth": line["width"], "linestyle": "--" if "dash" in line else "-"}
            panel.plot(_values(trace["x"]), _values(trace["y"]), label=label, **style)
    axis = chart["layout"]["yaxis"]
    panel.set_ylabel(axis["title"]["text"])
    panel.set_yscale(axis.get("type", "linear"))
    panel.set_ylim(*axis.get("range", (None, None)))


def _values(numbers: Any) -> Any:
    """Numbers of a trace, in plotly's encoding or not."""
    return np.frombuffer(base64.b64decode(numbers["bdata"]), numbers["dtype"]) if "bdata" in numbers else numbers


def _draw_moments(panel: Axes, bag: ReportBag, with_labels: bool) -> None:
    """Draw a line for the goal, its reaching and each stop."""
    moments = [("goal sent", 0.0, BLUE)] if bag.has_goal else []
    if np.isfinite(bag.reached):
        moments.append(("settled", bag.reached - bag.zero, GREEN))
    stops = [event for event in bag.signals.safety if event.is_stop and event.time < bag.end]
    moments += [(f"{stop.name} stop", stop.time - bag.zero, VERMILION) for stop in stops]
    for label, time, colour in moments:
        line = panel.axvline(time, color=colour, linewidth=1.1, linestyle="--", zorder=1.5)
        if with_labels:
            line.set_label(f"{label}, {time:.2f} s")
