"""Reactions of the planner to contact that no known obstacle explains: avoid the place, or retreat."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.node_settings import IGNORE, REPLAN, RETREAT, UnexpectedContactSettings
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.world.clearance import clearances
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

RETREAT_TO = "retreat to"
"""Key of `ContactReaction.values` while the arm goes back."""

_KNOWN_WITHIN = 0.01
"""A contact is attributed to a known obstacle if one is nearer to the arm than this, m."""
_STEP = 0.005
"""Distance between remembered positions of the flange, m."""
_STIFFNESS, _DAMPING = 1e5, 500.0
"""Stiffness and damping of the sphere that stands for the contact, N/m and N s/m: it does not give way."""


class ContactReaction:
    """Turns contacts that the observer reports into goals and obstacles for the planner.

    Attributes
    ----------
    reason
        Reason for the reaction in force; empty without one.
    """

    def __init__(
        self, arm: Arm, settings: UnexpectedContactSettings, contact_stiffness: float, sees_spheres: bool
    ) -> None:
        """`contact_stiffness`: that of the planner's model, N/m; a planner without spheres can only retreat."""
        self._arm = arm
        self._radii: dict[str, float] = {}
        for capsule in arm.capsules:
            link = arm.link_names[capsule.link - 1]
            self._radii[link] = max(capsule.radius, self._radii.get(link, 0.0))
        self._settings = settings
        self._stiffness = contact_stiffness
        self.reaction = RETREAT if settings.reaction == REPLAN and not sees_spheres else settings.reaction
        self.reset()

    def reset(self) -> None:
        """Forget everything, because the goal has changed or was withdrawn."""
        self.reason = ""
        self._since_ns: int | None = None
        self._spheres: list[Array] = []
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
        if self.reaction == IGNORE or self._target is not None:
            return False
        known = len(spheres) > 0 and bool(clearances(self._arm, q, spheres).min() < _KNOWN_WITHIN)
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
            # Further contact near a sphere is with the same object, located better.
            near = [place for place in self._spheres if math.dist(place, center) < 2.0 * self._settings.radius]
            self._spheres = [place for place in self._spheres if not any(place is other for other in near)] + [center]
        else:
            self._target = self._way_back()
        return True

    @property
    def is_retreating(self) -> bool:
        """Whether the arm goes back instead of to its goal."""
        return self._target is not None

    def values(self) -> dict[str, str]:
        """The reaction in force by name, as JSON, for plan/statistics; empty without one."""
        values: dict[str, str] = {}
        if self._target is not None:
            values[RETREAT_TO] = json.dumps(self._target.tolist())
        if self._spheres:
            values["touched"] = json.dumps([place.tolist() for place in self._spheres])
        return values

    def goal(self, goal: Target) -> Target:
        """The goal to plan for."""
        return goal if self._target is None else dataclasses.replace(goal, position=self._target)

    def spheres(self, spheres: Spheres) -> Spheres:
        """The obstacles to plan with: the known ones and a sphere at each touched place."""
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
            environment=spheres.environment,
        )

    def _center(self, contact: Contact) -> Array:
        """Centre of a sphere that pushes the link with the measured force in the planner's model, F / k deep."""
        depth = contact.strength / self._stiffness
        distance = self._radii[contact.link] + self._settings.radius - depth
        return contact.position - distance / contact.strength * contact.force

    def _way_back(self) -> Array:
        """The last position of the flange as far away as the retreat, or the first one."""
        here = self._path[-1]
        for position in reversed(self._path):
            if math.dist(position, here) >= self._settings.retreat:
                return position
        return self._path[0]
