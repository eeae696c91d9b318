"""What happened in an episode."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.timing import PERIOD


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """What happened, from the moment the goal was given.

    Attributes
    ----------
    duration
        Time until the goal was first reached, s; NaN if it was not.
    settled
        Time until the planner reported the goal settled, s; NaN if it did not, or the episode ended as soon as the goal
        was reached.
    start_position
        (3,) position of the tip before, m.
    positions
        (T, 3) of the tip after each tick, m.
    joints
        (T, n) joint angles, rad.
    link_forces
        (T, L) contact force on each of the arm's contact links, N.
    external_torques
        (T, n) residuals, Nm.
    distances
        (T,) of the tip from the target, m.
    stop_reason
        Empty if nothing stopped the arm.
    failure
        Why there is no plan, if there is none; the episode ends with it.
    plans
        All plans in order.
    reasons
        Why each of `observer`, `controller` and `drive` stopped the arm, where they did, or why it was not started.
    refused
        How many messages were refused, by what they were.
    end_speed
        Of the fastest joint at the end, rad/s.
    period
        Time between joint states, s.
    command_times, commands
        (C,) s and (C, n) Nm: everything that the controller sent, also before the goal.
    """

    duration: float
    start_position: Array
    positions: Array
    joints: Array
    link_forces: Array
    external_torques: Array
    distances: Array
    stop_reason: str
    failure: str
    plans: list[Plan]
    reasons: dict[str, str] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    end_speed: float = float("nan")
    period: float = PERIOD
    settled: float = float("nan")
    until_settled: bool = False
    command_times: Array = field(default_factory=lambda: np.zeros(0))
    commands: Array = field(default_factory=lambda: np.zeros((0, 1)))

    @property
    def contact_forces(self) -> Array:
        """(T,) largest on one link, N."""
        return self.link_forces.max(axis=1)

    @property
    def reached(self) -> bool:
        """Whether the goal was reached, with rest if that was asked for, and nothing stopped the arm."""
        return bool(np.isfinite(self.time)) and not self.stop_reason

    @property
    def time(self) -> float:
        """`settled` if rest was asked for, else `duration`, s."""
        return self.settled if self.until_settled else self.duration
