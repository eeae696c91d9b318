"""A plan read from visualization markers, of any object with the fields of the messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.values import FARTHEST, vector

FLANGE = "flange"
ELBOW = "elbow"
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
    """

    flange: Array
    elbow: Array


def read_plan(message: Any) -> PlanPicture | None:
    """The plan in a MarkerArray of plan/markers; None if the message has none, which withdraws it.

    Raises `InputError` if a place is none.
    """
    paths = {FLANGE: np.zeros((0, 3)), ELBOW: np.zeros((0, 3))}
    for marker in message.markers:
        if marker.action == _ADD and marker.ns in paths:
            paths[marker.ns] = np.array([vector(point) for point in marker.points]).reshape(-1, 3)
    if not len(paths[FLANGE]):
        return None
    picture = PlanPicture(paths[FLANGE], paths[ELBOW])
    for name, values in vars(picture).items():
        if not (np.abs(values) < FARTHEST).all():
            raise InputError(f"plan/markers: {name} = {values.tolist()}; expected finite numbers below {FARTHEST:g} m")
    return picture
