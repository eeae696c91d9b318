"""From the signals of a recorded episode to its picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from contact_reach_ros.recording.plot import SUCCESS_DISTANCE, EpisodeCurves, Marker
from contact_reach_ros.recording.signals import (
    CONTACT_MAXIMUM,
    CONTACT_SUM,
    EpisodeSignals,
    first_below,
    goal_distance,
)

_LABEL_LENGTH = 44


def episode_curves(
    signals: EpisodeSignals,
    flange_position: Callable[[np.ndarray], np.ndarray],
    success_distance: float = SUCCESS_DISTANCE,
) -> EpisodeCurves:
    """Curves and moments to draw of an episode.

    Parameters
    ----------
    signals :
        The episode.
    flange_position :
        Forward kinematics: joint positions (7,) in rad to the position (3,) in m, in the frame of the goals.
    success_distance :
        A goal counts as reached when the flange first comes this close, m.
    """
    time, distance = goal_distance(signals, flange_position)
    markers = [*_goal_markers(signals, time, distance, success_distance), *_safety_markers(signals)]
    return EpisodeCurves(
        time,
        distance,
        signals.contact_force.time,
        signals.contact_force.column(CONTACT_MAXIMUM),
        signals.contact_force.column(CONTACT_SUM),
        signals.external_torque.time,
        signals.external_torque.values,
        markers,
    )


def _goal_markers(
    signals: EpisodeSignals, time: np.ndarray, distance: np.ndarray, success_distance: float
) -> Iterator[Marker]:
    ends = [goal.time for goal in signals.goals[1:]] + [np.inf]
    for goal, end in zip(signals.goals, ends, strict=True):
        yield Marker(goal.time, "goal sent", "goal")
        reached = first_below(time, distance, success_distance, after=goal.time)
        if reached is not None and reached < end:
            yield Marker(reached, "reached", "reached")


def _safety_markers(signals: EpisodeSignals) -> Iterator[Marker]:
    """Where a node's state turns from good to bad, to another bad one, or back."""
    wrong: dict[str, bool] = {}
    for event in signals.safety:
        if event.level > 0 or wrong.get(event.name, False):
            label = f"{event.name}: {event.message}"
            if len(label) > _LABEL_LENGTH:
                label = label[: _LABEL_LENGTH - 1] + "…"
            yield Marker(event.time, label, "safety")
        wrong[event.name] = event.level > 0
