"""A plan as the messages that controller, viewers and bags take, and as visualization markers."""

from __future__ import annotations

import array
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.messages.conversions import (
    set_time,
    to_duration,
    to_marker,
    to_point,
    to_quaternion,
    to_time,
    to_transform,
)
from contact_reach_ros.messages.diagnostics import to_status
from contact_reach_ros.messages.plan_reader import ARM, CONTACT, ELBOW, FLANGE
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.world.collision import capsule_segments


class ReferenceMessages(NamedTuple):
    """The halves of a plan, paired by their stamp, which is the plan's effect."""

    poses: MultiDOFJointTrajectory
    postures: JointTrajectory


def to_references(plan: Plan, arm: Arm) -> ReferenceMessages:
    """The knots of a plan for the controller."""
    header = _header(plan.effect_ns, arm)
    poses = MultiDOFJointTrajectory(header=header, joint_names=[arm.tip_frame])
    postures = JointTrajectory(header=header, joint_names=list(arm.joint_names))
    for index, (position, rotation, posture) in enumerate(
        zip(plan.positions, plan.rotations, plan.postures, strict=True), start=1
    ):
        end = to_duration(index * plan.knot_duration_ns)
        transform = to_transform(position, rotation)
        poses.points.append(MultiDOFJointTrajectoryPoint(transforms=[transform], time_from_start=end))
        postures.points.append(JointTrajectoryPoint(positions=posture.tolist(), time_from_start=end))
    return ReferenceMessages(poses, postures)


def to_path(plan: Plan, arm: Arm) -> Path:
    """The tip's predicted positions, from the effect on."""
    path = Path(header=_header(plan.effect_ns, arm))
    for index, position in enumerate(plan.predicted_positions.tolist()):
        pose = PoseStamped(header=_header(plan.effect_ns + index * plan.knot_duration_ns, arm))
        pose.pose.position = to_point(position)
        path.poses.append(pose)
    return path


def to_statistics(plan: Plan, values: Mapping[str, Any], name: str, arm: Arm) -> DiagnosticArray:
    """What a bag keeps of how a plan was found, published by the node `name`."""
    return DiagnosticArray(header=_header(plan.effect_ns, arm), status=[to_status(name, plan.stop_reason, values)])


def to_request(parts: Mapping[str, Array]) -> Float64MultiArray:
    """The parts of `plan_request` one after the other; the dimensions name them."""
    message = Float64MultiArray()
    message.layout.dim = [MultiArrayDimension(label=name, size=part.size) for name, part in parts.items()]
    message.data = array.array("d", np.concatenate([part.ravel() for part in parts.values()]).tobytes())
    return message


def _header(time_ns: int, arm: Arm) -> Header:
    return Header(stamp=to_time(time_ns), frame_id=arm.base_frame)


_SHOWN_FORCE = 0.05
"""Least force that is worth a text, N."""
_TEXT_HEIGHT = 0.04
_PATH_WIDTH = 0.006
_BLUE = (0.2, 0.4, 0.9, 0.9)
_ORANGE = (0.9, 0.55, 0.1, 0.9)
_GHOST = 0.25


class PlanMarkers:
    """Markers of plans; each message replaces the one before."""

    def __init__(self, arm: Arm, permitted_force: float) -> None:
        """`permitted_force`: contact of this force is red, N."""
        self._arm = arm
        self._permitted_force = permitted_force
        places = {link: place for place, link in enumerate(arm.contact_links)}
        self._places = [places[arm.link_names[capsule.link - 1]] for capsule in arm.capsules]

    def show(self, plan: Plan) -> MarkerArray:
        """Paths of flange and elbow, the arm at the end of the plan, and each link's largest contact force.

        A text stands where the link is expected to be at the end of the knot with that force. The direction of a force
        is not known from a plan.
        """
        arm = self._arm
        elbow = np.array([link_frames(arm, q)[1][arm.n // 2] for q in plan.predicted_q])
        markers = [_path(FLANGE, plan.predicted_positions, _BLUE), _path(ELBOW, elbow, _ORANGE)]
        forces = plan.predicted_contact_forces.max(axis=0)
        shares = np.clip(forces / self._permitted_force, 0.0, 1.0)
        starts, ends = capsule_segments(arm, plan.predicted_q[-1])
        for index, (capsule, place) in enumerate(zip(arm.capsules, self._places, strict=True)):
            share = shares[place]
            color = (0.5 + 0.5 * share, 0.5 - 0.4 * share, 0.5 - 0.4 * share, _GHOST)
            markers.append(_cylinder(index, starts[index], ends[index], capsule.radius, color))
            is_first = place not in self._places[:index]
            if forces[place] >= _SHOWN_FORCE and is_first:
                knot = int(plan.predicted_contact_forces[:, place].argmax())
                middle = np.mean(capsule_segments(arm, plan.predicted_q[knot + 1]), axis=0)[index]
                markers.append(_text(capsule.link, middle, f"{forces[place]:.1f} N", share))
        return self._replacing(markers, plan.effect_ns)

    def clear(self) -> MarkerArray:
        """Deletes all that is shown."""
        return self._replacing([], 0)

    def _replacing(self, markers: list[Marker], stamp_ns: int) -> MarkerArray:
        """These markers instead of all that were shown before."""
        message = MarkerArray(markers=[Marker(action=Marker.DELETEALL), *markers])
        for marker in message.markers:
            marker.header.frame_id = self._arm.base_frame
            set_time(marker.header.stamp, stamp_ns)
        return message


def _path(namespace: str, points: Array, color: tuple[float, ...]) -> Marker:
    marker = to_marker(namespace, 0, Marker.LINE_STRIP, (_PATH_WIDTH, 0.0, 0.0), color)
    marker.points = [to_point(point) for point in points.tolist()]
    return marker


def _cylinder(identifier: int, start: Array, end: Array, radius: float, color: tuple[float, ...]) -> Marker:
    axis = end - start
    length = float(np.linalg.norm(axis))
    marker = to_marker(ARM, identifier, Marker.CYLINDER, (2.0 * radius, 2.0 * radius, length), color)
    marker.pose.position = to_point((0.5 * (start + end)).tolist())
    marker.pose.orientation = to_quaternion(_frame_along(axis / length))
    return marker


def _text(link: int, position: Array, text: str, share: float) -> Marker:
    marker = to_marker(CONTACT, link, Marker.TEXT_VIEW_FACING, (0.0, 0.0, _TEXT_HEIGHT), (1.0, 1.0 - share, 0.0, 1.0))
    marker.pose.position = to_point(position.tolist())
    marker.text = text
    return marker


def _frame_along(axis: Array) -> Array:
    """A rotation (3, 3) whose z is the unit vector `axis`."""
    aside = np.eye(3)[np.abs(axis).argmin()]
    x = np.cross(aside, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
