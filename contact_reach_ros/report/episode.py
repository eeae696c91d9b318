"""The episode of a recording: one goal, until the arm has settled, is stopped, or the recording ends."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import Arm, tip_positions
from contact_reach_ros.bags.signals import EpisodeSignals, goal_distance
from contact_reach_ros.errors import BagError


class Episode:
    """The episode of a bag's first goal; without a goal, the whole recording.

    Raises `BagError` if there is no joint state.

    Parameters
    ----------
    signals
        Signals of the bag.
    arm
        The recorded arm.
    end
        Latest end of the episode, such as the shutdown of the stack, s since the first joint state.
    timeout, settle
        Times after the start and after the goal was reached at which the episode ends at the latest, s.

    Attributes
    ----------
    start, end
        When the first goal was sent, or 0 without a goal, and when the episode ended, s since the first joint state.
    has_goal
        Whether there is a goal.
    reached
        When the arm had settled at the goal, as the planner reported; on the same clock, NaN if it did not.
    way
        Distance from start to goal, m; NaN without a goal.
    distance
        Distance of the flange from the goal: the column "distance", m; empty without a goal.
    """

    def __init__(
        self,
        signals: EpisodeSignals,
        arm: Arm,
        end: float = np.inf,
        timeout: float = np.inf,
        settle: float = np.inf,
    ) -> None:
        position = signals.position
        if not np.isfinite(position.values).all(axis=1).any():
            raise BagError("holds no joint states of the arm; record joint_states")
        self.distance = goal_distance(signals, arm)
        self.has_goal = bool(len(self.distance.time))
        self.start = float(signals.goals.time[0]) if self.has_goal else 0.0
        last = min(float(position.time[-1]), end, self.start + timeout)
        settled = signals.settled[(signals.settled >= self.start) & (signals.settled <= last)]
        self.reached = float(settled[0]) if self.has_goal and len(settled) else float("nan")
        self.end = float(np.fmin(last, self.reached + settle))
        self.way = float("nan")
        if self.has_goal:
            row = min(int(np.searchsorted(position.time, self.start)), len(position.time) - 1)
            start_position = tip_positions(arm, position.values[row : row + 1])[0]
            self.way = float(np.linalg.norm(signals.goals.values[0] - start_position))
