"""Progress towards a goal: accepted, running, reached, settled, or ended in another way."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import Target, Task

SETTLE_NS = NANOSECONDS // 5
"""Time at rest within the goal's tolerances after which it has settled, ns: an overshoot would have left them."""


class GoalPhase(Enum):
    """Phases of a goal. The values are an interface: `goal/state` carries them."""

    ACCEPTED = "accepted"
    """There is no plan for it yet."""
    RUNNING = "running"
    REACHED = "reached"
    """The tip is or was there, but has not settled."""
    SETTLED = "settled"
    """The tip has stayed there, at rest; plans go on holding it."""
    REFUSED = "refused"
    WITHDRAWN = "withdrawn"
    TIMED_OUT = "timed out"

    @property
    def is_open(self) -> bool:
        """Whether the goal is pursued and has not settled."""
        return self in (GoalPhase.ACCEPTED, GoalPhase.RUNNING, GoalPhase.REACHED)

    @property
    def is_over(self) -> bool:
        """Whether the goal is not pursued any more."""
        return self in (GoalPhase.REFUSED, GoalPhase.WITHDRAWN, GoalPhase.TIMED_OUT)


class GoalState(NamedTuple):
    """What happened to a goal so far."""

    phase: GoalPhase
    reason: str = ""
    """Why it was refused or withdrawn; empty otherwise."""
    distance: float = math.nan
    """From the tip to its position, m."""
    angle: float = math.nan
    """From the tip's orientation to its, rad; 0 if any will do."""
    elapsed: float = 0.0
    """Time since it was accepted, or from then until it settled or ended, s."""


class GoalProgress:
    """Follows the tip on its way to one goal.

    Attributes
    ----------
    state
        What happened so far.
    """

    def __init__(self, task: Task, timeout: float) -> None:
        """Follow an accepted task.

        Parameters
        ----------
        task
            Decides where the tip has to be, and how quietly.
        timeout
            Time to settle, s; 0 for any.
        """
        self.state = GoalState(GoalPhase.ACCEPTED)
        self._task = task
        self._timeout_ns = round(timeout * NANOSECONDS)
        self._begun_ns: int | None = None
        self._there_ns: int | None = None
        """Since when the tip has been there, at rest."""

    def update(self, target: Target, position: Array, rotation: Array, speed: float, stamp_ns: int) -> bool:
        """Take the tip's pose, in the base frame, and its speed, m/s, at a time, ns.

        Returns whether the time is over now.
        """
        phase, reason = self.state.phase, self.state.reason
        if self._begun_ns is None or stamp_ns < self._begun_ns:
            self._begun_ns = stamp_ns
            self._there_ns = None
        elapsed_ns = stamp_ns - self._begun_ns
        if phase.is_open:
            if not self._task.settled(position, rotation, speed, target):
                self._there_ns = None
            elif self._there_ns is None or stamp_ns < self._there_ns:
                self._there_ns = stamp_ns
            if self._there_ns is not None and stamp_ns - self._there_ns >= SETTLE_NS:
                phase = GoalPhase.SETTLED
            elif phase is not GoalPhase.REACHED and self._task.reached(position, target):
                phase = GoalPhase.REACHED
            elif 0 < self._timeout_ns <= elapsed_ns:
                phase, reason = GoalPhase.TIMED_OUT, f"not settled within {self._timeout_ns / NANOSECONDS:g} s"
        was_open = self.state.phase.is_open
        elapsed = elapsed_ns / NANOSECONDS if was_open else self.state.elapsed
        distance = float(np.linalg.norm(position - target.position))
        self.state = GoalState(phase, reason, distance, target.angle(rotation), elapsed)
        return was_open and phase is GoalPhase.TIMED_OUT

    def planned(self) -> None:
        """Note that there is a plan."""
        if self.state.phase is GoalPhase.ACCEPTED:
            self.state = self.state._replace(phase=GoalPhase.RUNNING)

    def end(self, phase: GoalPhase, reason: str) -> None:
        """End the goal, unless it has ended."""
        if not self.state.phase.is_over:
            self.state = self.state._replace(phase=phase, reason=reason)
