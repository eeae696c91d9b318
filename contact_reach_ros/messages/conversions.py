"""Messages and their parts from times, arrays and texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from contact_reach_ros.arm import Arm, Array, quaternion_from_rotation
from contact_reach_ros.errors import code_of
from contact_reach_ros.messages.safety_state import ERROR, MONITORING, OK, STOP_CODE, WARN, findings
from contact_reach_ros.observer.observer import SafetyReport
from contact_reach_ros.observer.safety import SafetyLevel
from contact_reach_ros.timing import NANOSECONDS

_LEVELS = {SafetyLevel.FREE: OK, SafetyLevel.CONTACT: WARN, SafetyLevel.BLIND: ERROR, SafetyLevel.COLLISION: ERROR}


def to_time(nanoseconds: int) -> Time:
    """Stamp of a time in ns."""
    return Time(sec=nanoseconds // NANOSECONDS, nanosec=nanoseconds % NANOSECONDS)


def to_point(position: Sequence[float]) -> Point:
    """Point message."""
    return Point(x=float(position[0]), y=float(position[1]), z=float(position[2]))


def to_goal_pose(position: Sequence[float], frame: str, stamp: Time, rotation: Array | None = None) -> PoseStamped:
    """A goal for `goal_pose`: a position (3,), m, in a frame, and an orientation (3, 3), by default the identity."""
    goal = PoseStamped()
    goal.header.frame_id = frame
    goal.header.stamp = stamp
    goal.pose.position = to_point(position)
    goal.pose.orientation = to_quaternion(np.eye(3) if rotation is None else rotation)
    return goal


def to_quaternion(rotation: Array) -> Quaternion:
    """Quaternion message of a rotation matrix (3, 3)."""
    w, x, y, z = quaternion_from_rotation(rotation)
    return Quaternion(x=x, y=y, z=z, w=w)


def to_marker(namespace: str, identifier: int, kind: int, scale: Sequence[float], color: Sequence[float]) -> Marker:
    """Marker without a place: `scale` along x, y and z, m, and `color` as red, green, blue and opacity up to 1."""
    x, y, z = scale
    red, green, blue, opacity = (float(share) for share in color)
    marker = Marker(
        ns=namespace,
        id=identifier,
        type=kind,
        scale=Vector3(x=x, y=y, z=z),
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
    )
    marker.pose.orientation.w = 1.0
    return marker


def to_status(
    name: str, message: str, values: Mapping[str, Any], level: int = OK, hardware_id: str = ""
) -> DiagnosticStatus:
    """A DiagnosticStatus, its values as text."""
    return DiagnosticStatus(
        level=bytes([level]),
        name=name,
        message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


def to_safety_state(report: SafetyReport, name: str, arm: Arm) -> DiagnosticStatus:
    """The message of a report, published by the node `name`."""
    # Numbers are among the values only, so that the message changes when the state does.
    message = report.verdict.reason or (MONITORING if report.level is SafetyLevel.FREE else report.level.value)
    return to_status(name, message, findings(report), _LEVELS[report.level], arm.name)


def to_stop_state(name: str, arm: Arm, reason: str, otherwise: str, values: Mapping[str, str]) -> DiagnosticStatus:
    """The safety state of the node `name`: why it stopped the arm, or if `reason` is empty its state `otherwise`."""
    return to_status(
        name, reason or otherwise, {**values, STOP_CODE: code_of(reason)}, ERROR if reason else OK, arm.name
    )
