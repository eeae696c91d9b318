"""A plan as the messages that controller, viewers and bags take."""

from __future__ import annotations

import array
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.messages.conversions import to_duration, to_point, to_time, to_transform
from contact_reach_ros.messages.diagnostics import to_status
from contact_reach_ros.planning.plan import Plan


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


def to_request(parts: Mapping[str, NDArray[np.float32]]) -> Float32MultiArray:
    """The parts of `plan_request` one after the other; the dimensions name them."""
    message = Float32MultiArray()
    message.layout.dim = [MultiArrayDimension(label=name, size=part.size) for name, part in parts.items()]
    message.data = array.array("f", np.concatenate([part.ravel() for part in parts.values()]).tobytes())
    return message


def _header(time_ns: int, arm: Arm) -> Header:
    return Header(stamp=to_time(time_ns), frame_id=arm.base_frame)
