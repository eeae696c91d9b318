"""Plans as messages: references, path and markers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped, Transform, Vector3
from nav_msgs.msg import Path
from std_msgs.msg import Header
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.messages.conversions import to_marker, to_point, to_quaternion, to_time
from contact_reach_ros.messages.plan_reader import CONTACT, ELBOW, FLANGE
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.collision import capsule_segments

_SHOWN_FORCE = 0.05
"""Least force that is worth a text, N."""
_TEXT_HEIGHT = 0.04
_PATH_WIDTH = 0.006
_BLUE = (0.2, 0.4, 0.9, 0.9)
_ORANGE = (0.9, 0.55, 0.1, 0.9)


def to_references(plan: Plan, arm: Arm) -> tuple[MultiDOFJointTrajectory, JointTrajectory]:
    """The knots of a plan for the controller: poses and postures, paired by their stamp, which is the plan's effect."""
    header = to_header(plan.effect_ns, arm)
    poses = MultiDOFJointTrajectory(header=header, joint_names=[arm.tip_frame])
    postures = JointTrajectory(header=header, joint_names=list(arm.joint_names))
    for index, (position, rotation, posture) in enumerate(
        zip(plan.positions, plan.rotations, plan.postures, strict=True), start=1
    ):
        seconds, nanosec = divmod(index * plan.knot_duration_ns, NANOSECONDS)
        end = Duration(sec=seconds, nanosec=nanosec)
        x, y, z = position.tolist()
        transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(rotation))
        poses.points.append(MultiDOFJointTrajectoryPoint(transforms=[transform], time_from_start=end))
        postures.points.append(JointTrajectoryPoint(positions=posture.tolist(), time_from_start=end))
    return poses, postures


def to_path(plan: Plan, arm: Arm) -> Path:
    """The tip's predicted positions, from the effect on."""
    path = Path(header=to_header(plan.effect_ns, arm))
    for index, position in enumerate(plan.predicted_positions.tolist()):
        pose = PoseStamped(header=to_header(plan.effect_ns + index * plan.knot_duration_ns, arm))
        pose.pose.position = to_point(position)
        path.poses.append(pose)
    return path


def to_header(time_ns: int, arm: Arm) -> Header:
    """Header of what is in the arm's base frame."""
    return Header(stamp=to_time(time_ns), frame_id=arm.base_frame)


def to_markers(plan: Plan | None, arm: Arm) -> MarkerArray:
    """Paths of flange and elbow, and each link's largest contact force, instead of all that was shown before.

    None shows nothing. A text stands where the link is expected to be at the end of the knot with that force. The
    direction of a force is not known from a plan.
    """
    markers = [Marker(action=Marker.DELETEALL)]
    if plan is not None:
        elbow = np.array([link_frames(arm, q)[1][arm.n // 2] for q in plan.predicted_q])
        markers += [_path(FLANGE, plan.predicted_positions, _BLUE), _path(ELBOW, elbow, _ORANGE), *_forces(plan, arm)]
    for marker in markers:
        marker.header = to_header(0 if plan is None else plan.effect_ns, arm)
    return MarkerArray(markers=markers)


def _path(namespace: str, points: Array, color: tuple[float, ...]) -> Marker:
    marker = to_marker(namespace, 0, Marker.LINE_STRIP, (_PATH_WIDTH, 0.0, 0.0), color)
    marker.points = [to_point(point) for point in points.tolist()]
    return marker


def _forces(plan: Plan, arm: Arm) -> Iterator[Marker]:
    links = [arm.link_names[capsule.link - 1] for capsule in arm.capsules]
    for forces, link in zip(plan.predicted_contact_forces.T, arm.contact_links, strict=True):
        knot, index = int(forces.argmax()), links.index(link)
        if forces[knot] >= _SHOWN_FORCE:
            middle = np.mean(capsule_segments(arm, plan.predicted_q[knot + 1]), axis=0)[index]
            number = arm.capsules[index].link
            marker = to_marker(CONTACT, number, Marker.TEXT_VIEW_FACING, (0.0, 0.0, _TEXT_HEIGHT), _ORANGE)
            marker.pose.position = to_point(middle.tolist())
            marker.text = f"{forces[knot]:.1f} N"
            yield marker
