"""The picture of an episode: distance to the goal, contact force and external torque over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contact_reach_ros.errors import BagError
from contact_reach_ros.palette import BLACK, BLUE, GREEN, GREY, JOINT_COLOURS, ORANGE, VERMILION
from contact_reach_ros.report.bag import ReportBag
from contact_reach_ros.world.goal import TOLERANCE

_AFTER = 0.2
"""Shown after the end of the episode, s."""


def draw_episode(bag: ReportBag, title: str, file: Path) -> None:
    """Draw the episode of a bag in three panels with a common time axis, and write it as a PNG.

    Raises `BagError` if the file cannot be written.
    """
    figure = Figure(figsize=(9.0, 7.6), dpi=130)
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 1.25)})
    _draw_distance(panels[0], bag)
    _draw_force(panels[1], bag)
    _draw_torque(panels[2], bag)
    for panel in panels:
        _draw_moments(panel, bag, with_labels=panel is panels[0])
        panel.grid(True, color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, borderaxespad=0.0)
    panels[2].set_xlabel("time since the goal was sent [s]")
    if bag.episode is not None:
        panels[2].set_xlim(bag.shown_from, bag.episode.end - bag.zero + _AFTER)
    figure.subplots_adjust(left=0.09, right=0.76, top=0.93, bottom=0.075, hspace=0.12)
    figure.suptitle(title, x=0.09, y=0.98, ha="left", fontsize=12, fontweight="bold")
    figure.align_ylabels(panels)
    try:
        figure.savefig(file, format="png")
    except OSError as error:
        raise BagError(f"plot '{file}' cannot be written: {error.strerror}") from error


def _draw_distance(panel: Axes, bag: ReportBag) -> None:
    if bag.episode is not None:
        distance = bag.episode.distance
        panel.plot(distance.time - bag.zero, distance.column("distance"), color=BLUE, linewidth=1.8, label="distance")
    label = f"tolerance, {TOLERANCE:g} m"
    panel.axhline(TOLERANCE, color=GREY, linewidth=1.0, linestyle="--", label=label)
    panel.set_ylabel("distance to goal [m]")
    panel.set_yscale("log")


def _draw_force(panel: Axes, bag: ReportBag) -> None:
    force, permitted = bag.signals.contact_force, bag.budget.permitted_force
    panel.plot(force.time - bag.zero, force.column("sum"), color=ORANGE, linewidth=1.4, label="sum of all bodies")
    panel.plot(force.time - bag.zero, force.column("max"), color=BLACK, linewidth=1.4, label="largest of any body")
    panel.axhline(permitted, color=VERMILION, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    panel.set_ylabel("contact force [N]")
    panel.set_ylim(bottom=0.0)


def _draw_torque(panel: Axes, bag: ReportBag) -> None:
    torque, thresholds = bag.signals.external_torque, bag.budget.torque_thresholds
    for joint, name in enumerate(torque.names):
        colour = JOINT_COLOURS[joint % len(JOINT_COLOURS)]
        panel.plot(torque.time - bag.zero, torque.values[:, joint], color=colour, linewidth=1.2, label=name)
        panel.axhline(thresholds[joint], color=colour, linewidth=0.9, linestyle=":")
        panel.axhline(-thresholds[joint], color=colour, linewidth=0.9, linestyle=":")
    panel.plot([], [], color=GREY, linewidth=0.9, linestyle=":", label="stop thresholds")
    # The nearest threshold stays in view; those far above would flatten the curves.
    shown = 1.15 * max(float(np.nanmax(np.abs(torque.values), initial=0.0)), min(thresholds))
    panel.set_ylim(-shown, shown)
    panel.set_ylabel("external torque [Nm]")


def _draw_moments(panel: Axes, bag: ReportBag, with_labels: bool) -> None:
    """Draw a line for the goal, its reaching and each stop."""
    if bag.episode is None:
        return
    moments = [("goal sent", 0.0, BLUE)] if bag.episode.has_goal else []
    if np.isfinite(bag.episode.reached):
        moments.append(("settled", bag.episode.reached - bag.zero, GREEN))
    stops = [event for event in bag.signals.safety if event.is_stop and event.time < bag.episode.end]
    moments += [(f"{stop.name} stop", stop.time - bag.zero, VERMILION) for stop in stops]
    for label, time, colour in moments:
        line = panel.axvline(time, color=colour, linewidth=1.1, linestyle="--", zorder=1.5)
        if with_labels:
            line.set_label(f"{label}, {time:.2f} s")
