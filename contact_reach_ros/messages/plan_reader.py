"""Plans from the planner's messages, or any object with their fields: for the controller, and as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import Array, rotation_from_quaternion
from contact_reach_ros.control.references import References
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.values import FARTHEST, nanoseconds, places_of, vector

if TYPE_CHECKING:
    from contact_reach_ros.control.controller import Controller

FLANGE = "flange"
ELBOW = "elbow"
CONTACT = "contact"
"""Namespaces of the markers."""

_POSE, _POSTURE = "reference/pose", "reference/posture"
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


def read_poses(message: Any) -> tuple[Array, Array]:
    """Positions (H, 3), m, and rotations (H, 3, 3) of the x_d in a MultiDOFJointTrajectory.

    Raises `InputError` if a point has not one transform, or a rotation is none.
    """
    if any(len(point.transforms) != 1 for point in message.points):
        raise InputError("reference/pose: each point needs exactly one transform, the flange's x_d")
    transforms = [point.transforms[0] for point in message.points]
    positions = [vector(transform.translation) for transform in transforms]
    turns = [(turn.w, turn.x, turn.y, turn.z) for turn in (transform.rotation for transform in transforms)]
    if not all(1e-6 < math.hypot(*turn) < math.inf for turn in turns):
        raise InputError("reference/pose: rotations must be finite quaternions of non-zero length")
    rotations = [rotation_from_quaternion(turn) for turn in turns]
    return np.reshape(np.array(positions, float), (-1, 3)), np.reshape(np.array(rotations, float), (-1, 3, 3))


def read_postures(message: Any, joint_names: Sequence[str]) -> Array:
    """The q_d (H, n), rad, in a JointTrajectory, its joints in the order of `joint_names`.

    Raises `InputError` if joints are missing, or a point has not one position for each name.
    """
    names = list(message.joint_names)
    places = places_of(joint_names, names, _POSTURE)
    if any(len(point.positions) != len(names) for point in message.points):
        raise InputError("reference/posture: each point needs one position for each joint name")
    return np.array([point.positions for point in message.points], dtype=float).reshape(-1, len(names))[:, places]


class PlanReader:
    """Hands plans to the controller, which come as two messages of the same stamp, in any order.

    Of each topic the newest message waits for the other one: a plan is of no use once the next one is there.
    """

    def __init__(self, controller: Controller) -> None:
        """`controller`: that follows the plans."""
        self._controller = controller
        self._halves: dict[str, tuple[int, tuple[int, ...], tuple[Array, ...]]] = {}
        """By topic stamp and times, ns, and values of the newest message, until its plan is complete."""

    def take_poses(self, message: Any) -> None:
        """Take a message of reference/pose; without a point, it withdraws all plans.

        Raises `InputError` if it cannot be read, the plan is refused, or the message before it stayed alone.
        """
        self._take(_POSE, message, read_poses(message))

    def take_postures(self, message: Any) -> None:
        """Take a message of reference/posture, as `take_poses`."""
        self._take(_POSTURE, message, (read_postures(message, self._controller.arm.joint_names),))

    def _take(self, topic: str, message: Any, values: tuple[Array, ...]) -> None:
        if not message.points:
            self._halves.clear()
            self._controller.withdraw()
            return
        stamp_ns = nanoseconds(message.header.stamp)
        ends_ns = tuple(nanoseconds(point.time_from_start) for point in message.points)
        is_alone, self._halves[topic] = topic in self._halves, (stamp_ns, ends_ns, values)
        poses, postures = self._halves.get(_POSE), self._halves.get(_POSTURE)
        if poses and postures and poses[0] == postures[0]:
            self._halves.clear()
            if poses[1] != postures[1]:
                raise InputError(
                    f"{_POSE} and {_POSTURE} of one stamp have different time_from_start; expected the same"
                )
            self._controller.follow(References(stamp_ns, ends_ns, *poses[2], *postures[2]))
        elif is_alone:
            raise InputError(
                f"{topic}: the message before this one came without its other half; expected {_POSE} and {_POSTURE} of "
                "the same stamp for each plan"
            )
