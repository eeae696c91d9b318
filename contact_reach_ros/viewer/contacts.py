"""Where the arm is touched, as arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.overlap import capsule_segments
from contact_reach_ros.viewer.frame import Frame

Array = NDArray[np.float64]

_LEAST = 0.2
"""Force that is worth an arrow, N."""

_PLACES = {iiwa14.LINK_NAMES[capsule.link - 1]: place for place, capsule in enumerate(iiwa14.CAPSULES)}


class Arrow(NamedTuple):
    """A force on the arm.

    Attributes
    ----------
    point
        (3,) where it acts, m.
    force
        (3,), N.
    estimated
        By the observer from torques, rather than known from simulation.
    """

    point: Array
    force: Array
    estimated: bool


def arrows(frame: Frame) -> list[Arrow]:
    """The contacts of a moment.

    Simulation tells the size of the force on each link: it is drawn where the link is nearest to an obstacle, along
    their common normal. The observer tells size, direction and place.
    """
    starts, ends = capsule_segments(frame.q)
    found = []
    for name, size in frame.forces.items():
        if name in _PLACES and size >= _LEAST and frame.obstacles is not None and len(frame.obstacles):
            place = _PLACES[name]
            point, normal = _nearest(starts[place], ends[place], iiwa14.CAPSULES[place].radius, frame.obstacles)
            found.append(Arrow(point, size * normal, False))
    for status in frame.safety.values():
        contact = status.contact
        if contact is not None and np.linalg.norm(contact.force) >= _LEAST:
            found.append(Arrow(contact.position, contact.force, True))
    return found


def _nearest(start: Array, end: Array, radius: float, spheres: Spheres) -> tuple[Array, Array]:
    """The point of a capsule that is nearest to, or deepest in, a sphere, and the unit vector from there inwards."""
    axis = end - start
    along = np.clip((spheres.center - start) @ axis / (axis @ axis), 0.0, 1.0)
    towards = start + along[:, None] * axis - spheres.center
    lengths = np.linalg.norm(towards, axis=1)
    nearest = int(np.argmin(lengths - spheres.radius))
    normal = towards[nearest] / max(lengths[nearest], 1e-9)
    return start + along[nearest] * axis - radius * normal, normal
