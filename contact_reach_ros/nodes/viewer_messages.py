"""Decoding of the messages that the viewer shows, from topics and from bags."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.goals import goal_in
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.obstacle_markers import SerializedObstacleReader
from contact_reach_ros.messages.obstacle_reader import AssumedMaterial
from contact_reach_ros.messages.plan_markers import ARM, ELBOW, FLANGE
from contact_reach_ros.messages.safety_state import is_stopped, read_contact, read_level
from contact_reach_ros.messages.serialization import decode
from contact_reach_ros.messages.values import quaternion, vector
from contact_reach_ros.viewer.frame import PlanPicture, SafetyLevel, SafetyStatus
from contact_reach_ros.viewer.recorded import Decoders

_FARTHEST = 1e3
"""Of what is drawn, m."""

# Only positions, radii and edges are shown.
_ANY_MATERIAL = AssumedMaterial(1.0, 1.0, 1.0, 1.0, 1.0)


def make_decoders(arm: Arm) -> Decoders:
    """Make the decoders of the messages in a bag, some of which also come by topic."""
    obstacles = SerializedObstacleReader(arm.base_frame, _ANY_MATERIAL)
    return Decoders(
        obstacles.read_serialized,
        read_plan,
        read_goal,
        partial(read_status, arm=arm),
        read_numbers,
        lambda data: planned_goal(read_numbers(data)),
    )


def read_plan(data: bytes) -> PlanPicture | None:
    """Read the plan in a plan/markers message; None if the message withdraws the plan."""
    message: MarkerArray = decode(data, MarkerArray, topics.PLAN_MARKERS.name)
    paths = {FLANGE: np.zeros((0, 3)), ELBOW: np.zeros((0, 3))}
    starts, ends, radii = [], [], []
    for marker in message.markers:
        if marker.action == Marker.DELETEALL:
            return None
        if marker.action != Marker.ADD:
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
    picture = PlanPicture(
        paths[FLANGE],
        paths[ELBOW],
        np.array(starts).reshape(-1, 3),
        np.array(ends).reshape(-1, 3),
        np.array(radii, float),
    )
    for name, values in vars(picture).items():
        if not (np.abs(values) < _FARTHEST).all():
            raise InputError(
                f"plan/markers: {name} = {values.tolist()}; expected finite numbers below {_FARTHEST:g} m, and unit "
                "quaternions"
            )
    return picture


def read_goal(data: bytes) -> Array:
    """Read the position (3,) in a goal_pose message, m."""
    message: PoseStamped = decode(data, PoseStamped, topics.GOAL_POSE.name)
    position = vector(message.pose.position)
    if not np.isfinite(position).all():
        raise InputError(f"goal_pose: pose.position = {position.tolist()}; expected finite numbers in m")
    return position


def planned_goal(numbers: Mapping[str, float]) -> Array | None:
    """The goal (3,), m, among the numbers of plan/statistics; None if they have none.

    Raises
    ------
    InputError
        If it is nowhere.
    """
    goal = goal_in({key.rpartition("/")[2]: value for key, value in numbers.items()})
    if goal is not None and not (np.abs(goal) < _FARTHEST).all():
        raise InputError(f"plan/statistics: goal = {goal.tolist()}; expected numbers below {_FARTHEST:g} m")
    return goal


def read_status(data: bytes, arm: Arm) -> tuple[str, SafetyStatus]:
    """Read node and status in a safety_state message."""
    return status_in(decode(data, DiagnosticStatus, topics.SAFETY_STATE.name), arm)


def read_numbers(data: bytes) -> dict[str, float]:
    """Read the numbers in a diagnostics message, by '<node>/<key>'."""
    return numbers_in(decode(data, DiagnosticArray, topics.DIAGNOSTICS.name))


def status_in(message: DiagnosticStatus, arm: Arm) -> tuple[str, SafetyStatus]:
    """Node and status of a safety state; a malformed contact is left out."""
    try:
        contact = read_contact(message, arm)
    except InputError:
        contact = None
    level = (
        SafetyLevel.STOP if is_stopped(message) else SafetyLevel(min(read_level(message), SafetyLevel.CONTACT.value))
    )
    return message.name, SafetyStatus(level, message.message, contact)


def numbers_in(message: DiagnosticArray) -> dict[str, float]:
    """Numbers among the values of diagnostics, by '<node>/<key>'."""
    found = {}
    for status in message.status:
        for entry in status.values:
            try:
                found[f"{status.name}/{entry.key}"] = float(entry.value)
            except ValueError:
                continue
    return found
