"""Contact that no known obstacle explains."""

from __future__ import annotations

import math

import numpy as np

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.observer.location import Contact, ContactLocator
from contact_reach_ros.observer.observer import EXCESS_FORCE, LEAST_FORCE
from contact_reach_ros.world.collision import capsule_segments
from contact_reach_ros.world.spheres import Spheres

NEAR = 0.02
"""Greatest distance of a known obstacle from the arm at which it may touch it, m: so far it may be misplaced."""

_FRICTION = 0.5
"""Greatest friction of a known body, as a share of its normal force."""
_ROW_OF_SUM = 100.0
"""Weight of the sum of all forces in the fit, beside torques in units of the contact thresholds: it is kept exactly."""


Places = tuple[Array, Array, Array]
"""Where known bodies may touch the arm: links (P,), 0 for that of the first joint, points (P, 3) on the axes of their
capsules, m, and normals (P, 3) out of the bodies; base frame."""


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

    def unexpected(self, contact: Contact, q: Array, spheres: Spheres) -> Contact | None:
        """What is left of a contact at joint angles `q` (n,), rad; None if the obstacles explain it, or it is weak."""
        if contact.strength < LEAST_FORCE:
            return None
        places = places_near(self._arm, q, spheres)
        if len(places[0]) == 0 or not np.isfinite(contact.torque).all():
            return contact
        left = self._unexplained(q, contact.torque, places)
        if (np.abs(left) <= self._thresholds).all():
            return None
        found = self._locator.locate(q, left)
        return found if found.strength >= LEAST_FORCE else None

    def _unexplained(self, q: Array, torque: Array, places: Places) -> Array:
        """The part of an external torque (n,), N m, that forces at these places do not explain.

        At each place a force may act out of the body, within a friction cone, and all of them together with no more
        than is permitted.
        """
        # SciPy takes a while to import; the node does it before the arm moves.
        from scipy.optimize import nnls

        links, points, normals = places
        sides = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        across = np.cross(normals, sides)
        slope = math.hypot(1.0, _FRICTION)
        tilted = [(normals + _FRICTION * side) / slope for side in (sides, -sides, across, -across)]
        edges = np.stack([normals, *tilted], axis=2)
        rows = self._locator.rows(*self._locator.frames(q), points, links)
        columns = (rows @ edges).transpose(1, 0, 2).reshape(len(q), -1)
        # One force more, which moves nothing, takes up what the others leave of the permitted force.
        columns = np.hstack([self._most * columns, np.zeros((len(q), 1))])
        sums = np.full((1, columns.shape[1]), _ROW_OF_SUM)
        target = np.append(self._locator.weights * torque, _ROW_OF_SUM)
        try:
            shares, _ = nnls(np.vstack([columns, sums]), target)
        except RuntimeError:  # after many iterations
            return torque
        return torque - columns @ shares / self._locator.weights


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
    return links[capsules], points[near], normals[near] / distances[near, None]
