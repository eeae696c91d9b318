"""A plan read from visualization markers, of any object with the fields of the messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.values import FARTHEST, quaternion, vector

FLANGE = "flange"
ELBOW = "elbow"
ARM = "arm"
CONTACT = "contact"
"""Namespaces of the markers."""

_ADD = 0
"""Action of a visualization_msgs/msg/Marker."""


@dataclass(frozen=True)
class PlanPicture:
    """Motion that a plan predicts.

    Attributes
    ----------
    flange, elbow
        (N, 3) positions at the knots, m.
    ghost_starts, ghost_ends
        (k, 3) ends of the axes of the arm's cylinders at the last knot, m.
    ghost_radii
        (k,), m.
    """

    flange: Array
    elbow: Array
    ghost_starts: Array
    ghost_ends: Array
    ghost_radii: Array


def read_plan(message: Any) -> PlanPicture | None:
    """The plan in a MarkerArray of plan/markers; None if the message has none, which withdraws it.

    Raises `InputError` if a place is none, or an orientation no unit quaternion.
    """
    paths = {FLANGE: np.zeros((0, 3)), ELBOW: np.zeros((0, 3))}
    starts, ends, radii = [], [], []
    for marker in message.markers:
        if marker.action != _ADD:
            continue
        if marker.ns in paths:
            paths[marker.ns] = np.array([vector(point) for point in marker.points]).reshape(-1, 3)
        elif marker.ns == ARM:
            x, y, z, w = quaternion(marker.pose.orientation).tolist()
            if not 0.99 < math.hypot(x, y, z, w) < 1.01:
                raise InputError(f"plan/markers: orientation = {x, y, z, w}; expected a unit quaternion x, y, z, w")
            half = 0.5 * marker.scale.z * rotation_from_quaternion((w, x, y, z))[:, 2]
            middle = vector(marker.pose.position)
            starts.append(middle - half)
            ends.append(middle + half)
            radii.append(0.5 * marker.scale.x)
    if not len(paths[FLANGE]):
        return None
    picture = PlanPicture(
        paths[FLANGE],
        paths[ELBOW],
        np.array(starts).reshape(-1, 3),
        np.array(ends).reshape(-1, 3),
        np.array(radii, float),
    )
    for name, values in vars(picture).items():
        if not (np.abs(values) < FARTHEST).all():
            raise InputError(
                f"plan/markers: {name} = {values.tolist()}; expected finite numbers below {FARTHEST:g} m, and unit "
                "quaternions"
            )
    return picture
