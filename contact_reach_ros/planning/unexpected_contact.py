"""Reaction of the planner to contact that no known obstacle explains: the arm retreats, or goes on."""

from __future__ import annotations

import dataclasses
import json
import math

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.settings import IGNORE, RETREAT, UnexpectedContactSettings
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.collision import clearances
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

RETREAT_TO = "retreat to"
"""Key of `ContactReaction.values` while the arm goes back."""

LEAST_FORCE = 5.0
"""Least force of a contact that counts, N: above the observer's errors where contacts are located."""
PATIENCE_NS = NANOSECONDS // 100
"""Least duration of a contact that counts, ns: ten states, so that no single one leads to a retreat."""
RETREAT_DISTANCE = 0.05
"""Distance of the retreat, m: enough to free a hand."""

_KNOWN_WITHIN = 0.01
"""A contact is attributed to a known obstacle if one is nearer to the arm than this, m."""
_STEP = 0.005
"""Distance between remembered positions of the flange, m."""


class ContactReaction:
    """Turns contacts that the observer reports into a goal where the arm came from.

    Attributes
    ----------
    reason
        Reason for the retreat in force; empty without one.
    """

    def __init__(self, arm: Arm, settings: UnexpectedContactSettings) -> None:
        self._arm = arm
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget everything, because the goal has changed or was withdrawn."""
        self.reason = ""
        self._since_ns: int | None = None
        self._path: list[Array] = []
        self._target: Array | None = None

    def moved(self, flange: Array) -> None:
        """Remember a position (3,) of the flange, m."""
        if not self._path or math.dist(flange, self._path[-1]) > _STEP:
            self._path.append(flange.copy())

    def report(self, contact: Contact | None, q: Array, spheres: Spheres, stamp_ns: int) -> bool:
        """Take a contact at joint angles `q` (n,), rad, or None for no contact; returns whether plans change.

        `spheres`: the obstacles that the planner knows.
        """
        if self._settings.reaction == IGNORE or self._target is not None:
            return False
        known = len(spheres) > 0 and bool(clearances(self._arm, q, spheres).min() < _KNOWN_WITHIN)
        if contact is None or known or contact.strength < LEAST_FORCE:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = stamp_ns
        if stamp_ns - self._since_ns < PATIENCE_NS or not self._path:
            return False
        self.reason = f"{RETREAT}: unexpected contact at {contact.link}, {contact.strength:.0f} N"
        self._target = self._way_back()
        return True

    @property
    def is_retreating(self) -> bool:
        """Whether the arm goes back instead of to its goal."""
        return self._target is not None

    def values(self) -> dict[str, str]:
        """The retreat in force as JSON, for plan/statistics; empty without one."""
        return {} if self._target is None else {RETREAT_TO: json.dumps(self._target.tolist())}

    def goal(self, goal: Target) -> Target:
        """The goal to plan for."""
        return goal if self._target is None else dataclasses.replace(goal, position=self._target)

    def _way_back(self) -> Array:
        """The last position of the flange as far away as the retreat, or the first one."""
        here = self._path[-1]
        for position in reversed(self._path):
            if math.dist(position, here) >= RETREAT_DISTANCE:
                return position
        return self._path[0]
