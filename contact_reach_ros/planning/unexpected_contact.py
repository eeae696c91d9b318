"""What the planner does about a contact that it was not told of: it keeps away from it, or goes back."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.obstacles import clearances
from contact_reach_ros.planning.problem import Array, Goal, Spheres
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS

IGNORE, REPLAN, RETREAT = "ignore", "replan", "retreat"
REACTIONS = (IGNORE, REPLAN, RETREAT)

_KNOWN_WITHIN = 0.01
"""A contact while a known obstacle is nearer to the arm than this may be with that, m."""
_STEP = 0.005
"""Between remembered positions of the flange, m."""
_STIFFNESS, _DAMPING = 1e5, 500.0
"""Of what stands for the contact: it does not give way."""
_RETREAT_TO, _TOUCHED = "retreat to", "touched"
_RADII = {iiwa14.LINK_NAMES[capsule.link - 1]: capsule.radius for capsule in iiwa14.CAPSULES}


@dataclass(frozen=True)
class UnexpectedContactSettings(Settings):
    """When a contact that no known obstacle explains counts, and what becomes of it."""

    reaction: str = setting(
        RETREAT,
        "what becomes of a contact within the budget with nothing that is known: nothing; a sphere there for further "
        "plans, in which it pushes with the measured force; or back the way the flange came, where the arm waits for "
        "another goal",
        choices=REACTIONS,
    )
    patience: float = setting(0.01, "time for which it lasts", unit="s", minimum=0.0, maximum=5.0)
    least_force: float = setting(5.0, "force from which on it counts", unit="N", minimum=0.0, maximum=140.0)
    radius: float = setting(0.05, "of the sphere", unit="m", minimum=0.005, maximum=0.5)
    retreat: float = setting(0.05, "how far back", unit="m", minimum=0.01, maximum=0.5)


class ContactReaction:
    """Turns what the observer tells of contacts into other goals and obstacles for the planner.

    Attributes
    ----------
    reason
        What it reacts to; empty while it does not.
    """

    def __init__(self, settings: UnexpectedContactSettings, contact_stiffness: float, sees_spheres: bool) -> None:
        """`contact_stiffness` N/m of the planner's transfer model; a planner that sees no spheres can only retreat."""
        self._settings = settings
        self._stiffness = contact_stiffness
        self.reaction = RETREAT if settings.reaction == REPLAN and not sees_spheres else settings.reaction
        self.reset()

    def reset(self) -> None:
        """Forget everything: there is a new goal, or none."""
        self.reason = ""
        self._since_ns: int | None = None
        self._spheres: list[Array] = []
        self._path: list[Array] = []
        self._target: Array | None = None

    def moved(self, flange: Array) -> None:
        """Remember where the flange (3,), m, has been."""
        if not self._path or math.dist(flange, self._path[-1]) > _STEP:
            self._path.append(flange.copy())

    def report(self, contact: Contact | None, q: Array, spheres: Spheres, stamp_ns: int) -> bool:
        """Take what touches the arm at joint angles `q` (7,), rad; None for nothing. Returns whether plans change.

        `spheres`: the obstacles that the planner knows.
        """
        if self.reaction == IGNORE or self._target is not None:
            return False
        known = len(spheres) > 0 and bool(clearances(q, spheres).min() < _KNOWN_WITHIN)
        if contact is None or known or contact.strength < self._settings.least_force:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = stamp_ns
        if stamp_ns - self._since_ns < self._settings.patience * NANOSECONDS or not self._path:
            return False
        self.reason = f"unexpected contact at {contact.link}, {contact.strength:.0f} N"
        if self.reaction == REPLAN:
            center = self._center(contact)
            # What is touched for longer is the same thing, seen better.
            near = [place for place in self._spheres if math.dist(place, center) < 2.0 * self._settings.radius]
            self._spheres = [place for place in self._spheres if not any(place is other for other in near)] + [center]
        else:
            self._target = self._way_back()
        return True

    def told(self) -> dict[str, str]:
        """What changes plans now, as JSON by name, for bags; empty if nothing does."""
        told: dict[str, str] = {}
        if self._target is not None:
            told[_RETREAT_TO] = json.dumps(self._target.tolist())
        if self._spheres:
            told[_TOUCHED] = json.dumps([place.tolist() for place in self._spheres])
        return told

    def recall(self, told: Mapping[str, str]) -> None:
        """Change plans as then, by what `told` has said, among other values."""
        self.reset()
        if _RETREAT_TO in told:
            self._target = np.array(json.loads(told[_RETREAT_TO]))
        self._spheres = [np.array(place) for place in json.loads(told.get(_TOUCHED, "[]"))]

    def goal(self, goal: Goal) -> Goal:
        """The goal to plan for."""
        return goal if self._target is None else dataclasses.replace(goal, position=self._target)

    def spheres(self, spheres: Spheres) -> Spheres:
        """The obstacles to plan with: the known ones and what was touched."""
        if not self._spheres:
            return spheres
        found, count = np.array(self._spheres), len(self._spheres)
        return Spheres(
            center=np.concatenate([spheres.center, found]),
            rest=np.concatenate([spheres.rest, found]),
            radius=np.append(spheres.radius, np.full(count, self._settings.radius)),
            stiffness=np.append(spheres.stiffness, np.full(count, _STIFFNESS)),
            damping=np.append(spheres.damping, np.full(count, _DAMPING)),
            edges=spheres.edges,
            edge_stiffness=spheres.edge_stiffness,
        )

    def _center(self, contact: Contact) -> Array:
        """Where a sphere pushes the link with the measured force in the planner's model: F / k deep."""
        depth = contact.strength / self._stiffness
        distance = _RADII[contact.link] + self._settings.radius - depth
        return contact.position - distance / contact.strength * contact.force

    def _way_back(self) -> Array:
        """The last position of the flange that is as far away as the retreat, or where it began."""
        here = self._path[-1]
        for position in reversed(self._path):
            if math.dist(position, here) >= self._settings.retreat:
                return position
        return self._path[0]
