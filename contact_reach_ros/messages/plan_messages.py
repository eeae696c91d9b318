"""A plan as the messages that controller, viewers and bags take."""

from __future__ import annotations

import array
from collections.abc import Mapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Transform, Vector3
from nav_msgs.msg import Path
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.messages.conversions import to_point, to_quaternion, to_status, to_time
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.timing import NANOSECONDS


def to_references(plan: Plan, arm: Arm) -> tuple[MultiDOFJointTrajectory, JointTrajectory]:
    """The knots of a plan for the controller: poses and postures, paired by their stamp, which is the plan's effect."""
    header = _header(plan.effect_ns, arm)
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
