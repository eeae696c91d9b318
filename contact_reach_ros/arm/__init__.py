"""The arm: its kinematics and dynamics, and the MJCF, URDF and Pinocchio model made from its table."""

from contact_reach_ros.arm.arm import Arm, Array, Capsule, Inertia, Joint, checked_array
from contact_reach_ros.arm.joint_state import (
    BLIND_AFTER,
    REST_SPEED,
    JointState,
    check_fresh,
    check_rest,
    checked_torque,
)
from contact_reach_ros.arm.kinematics import (
    link_frames,
    link_frames_of_many,
    tensor_matrix,
    tip_positions,
)
from contact_reach_ros.arm.rotations import quaternion_from_rotation, rotation_from_quaternion

__all__ = [
    "BLIND_AFTER",
    "REST_SPEED",
    "Arm",
    "Array",
    "Capsule",
    "Inertia",
    "Joint",
    "JointState",
    "check_fresh",
    "check_rest",
    "checked_array",
    "checked_torque",
    "link_frames",
    "link_frames_of_many",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "tensor_matrix",
    "tip_positions",
]
