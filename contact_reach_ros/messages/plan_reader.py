"""Plans from the planner's messages, or any object with their fields: for the controller, and as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import Array, rotation_from_quaternion
from contact_reach_ros.control.references import PoseKnots, PostureKnots
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.values import FARTHEST, nanoseconds, places_of, vector

FLANGE = "flange"
ELBOW = "elbow"
CONTACT = "contact"
"""Namespaces of the markers."""

_ADD = 0
"""Action of a visualization_msgs/msg/Marker."""


class PlanPicture(NamedTuple):
    """Positions (N, 3) that a plan predicts at its knots, m."""

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
    for name, values in picture._asdict().items():
        if not (np.abs(values) < FARTHEST).all():
            raise InputError(f"plan/markers: {name} = {values.tolist()}; expected finite numbers below {FARTHEST:g} m")
    return picture


def pose_knots(message: Any) -> PoseKnots:
    """The x_d half in a MultiDOFJointTrajectory.

    Raises `InputError` if a point has not one transform, or a rotation is none.
    """
    if any(len(point.transforms) != 1 for point in message.points):
        raise InputError("reference/pose: each point needs exactly one transform, the flange's x_d")
    transforms = [point.transforms[0] for point in message.points]
    positions = [vector(transform.translation) for transform in transforms]
    return PoseKnots(
        nanoseconds(message.header.stamp),
        tuple(nanoseconds(point.time_from_start) for point in message.points),
        np.array(positions, dtype=float).reshape(-1, 3),
        _rotations([transform.rotation for transform in transforms]),
    )


def posture_knots(message: Any, joint_names: Sequence[str]) -> PostureKnots:
    """The q_d half in a JointTrajectory, its joints in the order of `joint_names`.

    Raises `InputError` if joints are missing, or a point has not one position for each name.
    """
    names = list(message.joint_names)
    places = places_of(joint_names, names, "reference/posture")
    if any(len(point.positions) != len(names) for point in message.points):
        raise InputError("reference/posture: each point needs one position for each joint name")
    postures = np.array([point.positions for point in message.points], dtype=float).reshape(-1, len(names))
    return PostureKnots(
        nanoseconds(message.header.stamp),
        tuple(nanoseconds(point.time_from_start) for point in message.points),
        postures[:, places],
    )


def _rotations(quaternions: list[Any]) -> Array:
    """Rotation matrices (H, 3, 3)."""
    rotations = np.empty((len(quaternions), 3, 3))
    for index, turn in enumerate(quaternions):
        if not 1e-6 < math.hypot(turn.w, turn.x, turn.y, turn.z) < math.inf:
            raise InputError("reference/pose: rotations must be finite quaternions of non-zero length")
        rotations[index] = rotation_from_quaternion((turn.w, turn.x, turn.y, turn.z))
    return rotations
