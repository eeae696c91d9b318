"""From the planner's messages to the halves of a plan; any object with the fields of the message will do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.errors import InputError
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.joint_order import JointOrder
from contact_reach_ros.robot.kinematics import rotation_from_quaternion
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


def pose_knots(message: Any) -> PoseKnots:
    """The x_d half in a MultiDOFJointTrajectory.

    Raises
    ------
    InputError
        If a point has not one transform, or a rotation is none.
    """
    if any(len(point.transforms) != 1 for point in message.points):
        raise InputError("reference/pose: each point needs exactly one transform, the flange's x_d")
    transforms = [point.transforms[0] for point in message.points]
    positions = [(place.x, place.y, place.z) for place in (transform.translation for transform in transforms)]
    return PoseKnots(
        _nanoseconds(message.header.stamp),
        tuple(_nanoseconds(point.time_from_start) for point in message.points),
        np.array(positions, dtype=float).reshape(-1, 3),
        _rotations([transform.rotation for transform in transforms]),
    )


def posture_knots(message: Any) -> PostureKnots:
    """The q_d half in a JointTrajectory.

    Raises
    ------
    InputError
        If joints are missing, or a point has not one position for each name.
    """
    names = list(message.joint_names)
    indices = JointOrder(iiwa14.JOINT_NAMES).indices(names, "reference/posture")
    if any(len(point.positions) != len(names) for point in message.points):
        raise InputError("reference/posture: each point needs one position for each joint name")
    postures = np.array([point.positions for point in message.points], dtype=float).reshape(-1, len(names))
    return PostureKnots(
        _nanoseconds(message.header.stamp),
        tuple(_nanoseconds(point.time_from_start) for point in message.points),
        postures if indices is None else postures[:, indices],
    )


def _nanoseconds(time: Any) -> int:
    return time.sec * NANOSECONDS + time.nanosec


def _rotations(quaternions: list[Any]) -> Array:
    """Rotation matrices (H, 3, 3)."""
    rotations = np.empty((len(quaternions), 3, 3))
    for index, turn in enumerate(quaternions):
        if not 1e-6 < math.hypot(turn.w, turn.x, turn.y, turn.z) < math.inf:
            raise InputError("reference/pose: rotations must be finite quaternions of non-zero length")
        rotations[index] = rotation_from_quaternion((turn.w, turn.x, turn.y, turn.z))
    return rotations
