"""The picture of an episode: distance to the goal, contact force and external torque over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from contact_reach_ros.bags.signals import Series
from contact_reach_ros.drawing.palette import BLACK, BLUE, GREEN, GREY, JOINT_COLOURS, ORANGE, VERMILION
from contact_reach_ros.errors import BagError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.report.summary import SUCCESS_DISTANCE, Episode

_DOTS = (0, (1, 3))


def draw_episode(episode: Episode, title: str, budget: ContactBudget, file: Path) -> None:
    """Draw an episode in three panels with a common time axis, and write it as a PNG.

    Raises `BagError` if the file cannot be written.

    Parameters
    ----------
    episode
        What happened; a panel without recorded values says so.
    title
        One line: scene, seed, result.
    budget
        The permitted contact force and the torques at which the observer stops the arm.
    file
        Where the picture goes.
    """
    figure = Figure(figsize=(9.0, 7.6), dpi=130)
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": (1.0, 1.0, 1.25)})
    distance, force, torque = episode.curves()
    _draw_distance(panels[0], distance)
    _draw_force(panels[1], force, budget.permitted_force)
    _draw_torque(panels[2], torque, budget.torque_thresholds)
    _draw_moments(panels, episode.moments())
    for panel, series in zip(panels, (distance, force, torque), strict=True):
        if not len(series.time):
            panel.text(0.5, 0.5, "not recorded", transform=panel.transAxes, ha="center", color=GREY)
        panel.grid(True, color="#dddddd", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, borderaxespad=0.0)
    panels[2].set_xlabel("time since the goal was sent [s]" if episode.has_goal else "time [s]")
    figure.subplots_adjust(left=0.09, right=0.76, top=0.93, bottom=0.075, hspace=0.12)
    figure.suptitle(title, x=0.09, y=0.98, ha="left", fontsize=12, fontweight="bold")
    figure.align_ylabels(panels)
    try:
        figure.savefig(file, format="png")
    except OSError as error:
        raise BagError(f"plot '{file}' cannot be written: {error.strerror}") from error


def _draw_distance(panel: Axes, distance: Series) -> None:
    panel.plot(distance.time, distance.column("distance"), color=BLUE, linewidth=1.8, label="distance")
    label = f"success, {SUCCESS_DISTANCE:g} m"
    panel.axhline(SUCCESS_DISTANCE, color=GREY, linewidth=1.0, linestyle="--", label=label)
    panel.set_ylabel("distance to goal [m]")
    panel.set_yscale("log")


def _draw_force(panel: Axes, force: Series, permitted: float) -> None:
    panel.plot(force.time, force.column("sum"), color=ORANGE, linewidth=1.4, label="sum of all bodies")
    panel.plot(force.time, force.column("max"), color=BLACK, linewidth=1.4, label="largest of any body")
    panel.axhline(permitted, color=VERMILION, linewidth=1.0, linestyle="--", label=f"permitted, {permitted:g} N")
    panel.set_ylabel("contact force [N]")
    panel.set_ylim(bottom=0.0)


def _draw_torque(panel: Axes, torque: Series, thresholds: Sequence[float]) -> None:
    for joint, name in enumerate(torque.names):
        colour = JOINT_COLOURS[joint % len(JOINT_COLOURS)]
        panel.plot(torque.time, torque.values[:, joint], color=colour, linewidth=1.2, label=name)
        for value in (-thresholds[joint], thresholds[joint]):
            panel.axhline(value, color=colour, linewidth=0.9, linestyle=_DOTS, alpha=0.7)
    panel.plot([], [], color=GREY, linewidth=0.9, linestyle=_DOTS, label="stop thresholds")
    # The nearest threshold stays in view; those far above would flatten the curves.
    largest = max(float(np.nanmax(np.abs(torque.values), initial=0.0)), min(thresholds))
    panel.set_ylim(-1.15 * largest, 1.15 * largest)
    panel.set_ylabel("external torque [Nm]")


def _draw_moments(panels: Sequence[Axes], moments: Mapping[str, float]) -> None:
    """Draw a line through all panels for each moment: the goal, its reaching, and stops."""
    for label, time in moments.items():
        colour = {"goal sent": BLUE, "reached": GREEN}.get(label, VERMILION)
        for panel in panels:
            panel.axvline(time, linewidth=1.1, zorder=1.5, color=colour, linestyle="--")
        panels[0].plot([], [], linewidth=1.1, color=colour, linestyle="--", label=f"{label}, {time:.2f} s")
