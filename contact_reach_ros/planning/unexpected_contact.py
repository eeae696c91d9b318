"""Contact that no known obstacle explains."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact, ContactLocator, Places
from contact_reach_ros.observer.observer import EXCESS_FORCE, LEAST_FORCE
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.spheres import Spheres

NEAR = 0.02
"""Greatest distance of a known obstacle from the arm at which it may touch it, m: so far it may be misplaced."""


class Explanation:
    """Explains external torques by the obstacles that are known.

    Location is uncertain by a link, so it does not ask where: it subtracts what forces between the arm and obstacles
    near it explain, up to the permitted force. What is left is a contact with something else.
    """

    def __init__(self, arm: Arm, budget: ContactBudget) -> None:
        """`budget`: of the observer that reports the contacts."""
        budget = budget.resolve(arm)
        self._arm = arm
        self._thresholds = np.array(budget.contact_thresholds)
        self._locator = ContactLocator(RobotModel(arm), budget.contact_thresholds)
        self._most = budget.permitted_force + EXCESS_FORCE

    def unexpected(self, contact: Contact | None, q: Array, spheres: Spheres) -> Contact | None:
        """What is left of a contact at joint angles `q` (n,), rad; None if the obstacles explain it, or it is weak."""
        if contact is None or contact.strength < LEAST_FORCE:
            return None
        places = places_near(self._arm, q, spheres)
        if len(places.links) == 0 or not np.isfinite(contact.torque).all():
            return contact
        left = self._locator.unexplained(q, contact.torque, places, self._most)
        if (np.abs(left) <= self._thresholds).all():
            return None
        found = self._locator.locate(q, left)
        return found if found.strength >= LEAST_FORCE else None


def places_near(arm: Arm, q: Array, spheres: Spheres) -> Places:
    """Where spheres are so near to the arm at joint angles `q` (n,), rad, that they may touch it."""
    starts, ends = capsule_segments(arm, q)
    along = ends - starts
    offsets = spheres.center[:, None, :] - starts
    shares = np.clip((offsets * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    points = starts + shares[:, :, None] * along
    normals = points - spheres.center[:, None, :]
    distances = np.linalg.norm(normals, axis=2)
    radii = np.array([capsule.radius for capsule in arm.capsules])
    near = (distances - radii - spheres.radius[:, None] <= NEAR) & (distances > 0.0)
    _, capsules = np.nonzero(near)
    links = np.array([capsule.link - 1 for capsule in arm.capsules])
    return Places(links[capsules], points[near], normals[near] / distances[near, None])
