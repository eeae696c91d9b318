"""Progress towards a goal: accepted, running, following, reached, settled, or ended in another way."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.goal import Target, Task

SETTLE_NS = NANOSECONDS // 5
"""Time at rest within the goal's tolerances after which it has settled, ns: an overshoot would have left them."""


HOLD_NS = NANOSECONDS // 2
"""Time within a goal's tolerance after which a tip at rest holds its reference, ns: arms that come to rest on their own
come closer."""


class GoalPhase(Enum):
    """Phases of a goal. The values are an interface: `goal/state` carries them."""

    ACCEPTED = "accepted"
    """There is no plan for it yet."""
    RUNNING = "running"
    FOLLOWING = "following"
    """The goal moves, and the arm with it."""
    REACHED = "reached"
    """The tip is or was there, but has not settled."""
    SETTLED = "settled"
    """The tip has stayed there, at rest; plans go on holding it."""
    REFUSED = "refused"
    WITHDRAWN = "withdrawn"

    @property
    def is_open(self) -> bool:
        """Whether the goal is pursued and has not settled."""
        return self in (GoalPhase.ACCEPTED, GoalPhase.RUNNING, GoalPhase.FOLLOWING, GoalPhase.REACHED)

    @property
    def is_over(self) -> bool:
        """Whether the goal is not pursued any more."""
        return self in (GoalPhase.REFUSED, GoalPhase.WITHDRAWN)


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
    rest
        (3, 3) orientation with which the tip came within the tolerance of a goal that does not move; None while it is
        not there. Where the goal leaves the orientation free this one is held: a tip that turns on at random does not
        come to rest.
    holds
        Whether the tip is at rest within the tolerances after `HOLD_NS` there: to plan on, a little better each time,
        would move it for good.
    """

    def __init__(self, task: Task) -> None:
        """Follow an accepted task, which decides where the tip has to be, and how quietly."""
        self.state = GoalState(GoalPhase.ACCEPTED)
        self.rest: Array | None = None
        self.holds = False
        self._task = task
        self._begun_ns: int | None = None
        self._reached_ns: int | None = None
        """Since when the tip has been within the tolerance."""
        self._there_ns: int | None = None
        """Since when the tip has been there, at rest."""
        self._goes_on = False
        """Whether another goal of a stream has come since the last state."""

    def update(self, target: Target, position: Array, rotation: Array, speed: float, stamp_ns: int) -> None:
        """Take the tip's pose, in the base frame, and its speed, m/s, at a time, ns."""
        phase, elapsed = self.state.phase, self.state.elapsed
        is_there = self._task.reached(position, target)
        if target.moves or not is_there:
            self.rest = self._reached_ns = None
        elif self._reached_ns is None or stamp_ns < self._reached_ns:
            self.rest, self._reached_ns = rotation.copy(), stamp_ns
        at_rest = not target.moves and self._task.settled(position, rotation, speed, target)
        self.holds = at_rest and self._reached_ns is not None and stamp_ns - self._reached_ns >= HOLD_NS
        if self._begun_ns is None or stamp_ns < self._begun_ns:
            self._begun_ns = stamp_ns
            self._there_ns = None
        if phase.is_open or self._goes_on:
            elapsed, self._goes_on = (stamp_ns - self._begun_ns) / NANOSECONDS, False
            if not at_rest:
                self._there_ns = None
            elif self._there_ns is None or stamp_ns < self._there_ns:
                self._there_ns = stamp_ns
            if target.moves:
                phase = GoalPhase.FOLLOWING
            elif self._there_ns is not None and stamp_ns - self._there_ns >= SETTLE_NS:
                phase = GoalPhase.SETTLED
            elif is_there:
                phase = GoalPhase.REACHED
            elif phase in (GoalPhase.FOLLOWING, GoalPhase.SETTLED):
                phase = GoalPhase.RUNNING
        distance = float(np.linalg.norm(position - target.position))
        self.state = GoalState(phase, self.state.reason, distance, target.angle(rotation), elapsed)

    def go_on(self, task: Task) -> None:
        """Take the next goal of a stream, which may have left an arm behind that had settled."""
        self._task, self._goes_on = task, not self.state.phase.is_over

    def planned(self) -> None:
        """Note that there is a plan."""
        if self.state.phase is GoalPhase.ACCEPTED:
            self.state = self.state._replace(phase=GoalPhase.RUNNING)

    def end(self, phase: GoalPhase, reason: str) -> None:
        """End the goal, unless it has ended."""
        if not self.state.phase.is_over:
            self.state = self.state._replace(phase=phase, reason=reason)
