"""The arm as URDF, published as `robot_description` for RViz, tf and other ROS tools."""

from __future__ import annotations

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Arm, Capsule, Vector3
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.arm.mjcf import numbers
from contact_reach_ros.arm.mount import scene_frame, tilt


def build_urdf(arm: Arm, inertia_set: str = "nominal") -> str:
    """Build the URDF text of an arm, with the same link frames as the MJCF.

    Readers of URDFs let gravity act along -z of the root. That is the base, or for a tilted one a link without a shape
    that the base is fixed to.

    Raises
    ------
    SettingsError
        If the inertia set is unknown.
    """
    robot = Element("robot", name=arm.name)
    if tilt(arm):
        root = f"{arm.base_frame}_upright"
        SubElement(robot, "link", name=root)
        upright = scene_frame(arm).rotation.T
        _fix(robot, f"{arm.base_frame}_mount", root, arm.base_frame, (0.0, 0.0, 0.0), upright)
    base = SubElement(robot, "link", name=arm.base_frame)
    for capsule in arm.base_capsules:
        _add_capsule(base, capsule)
    parent = arm.base_frame
    inertias = arm.inertias(inertia_set)
    for number, (joint, name, inertia) in enumerate(zip(arm.joints, arm.link_names, inertias, strict=True), 1):
        link = SubElement(robot, "link", name=name)
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=numbers(inertia.center), rpy="0 0 0")
        SubElement(inertial, "mass", value=repr(inertia.mass))
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        SubElement(inertial, "inertia", {key: repr(value) for key, value in zip(keys, inertia.tensor, strict=True)})
        for capsule in arm.capsules:
            if capsule.link == number:
                _add_capsule(link, capsule)
        element = SubElement(robot, "joint", name=joint.name, type="revolute")
        rotation = rotation_from_quaternion(joint.rotation)
        SubElement(element, "origin", xyz=numbers(joint.offset), rpy=numbers(pin.rpy.matrixToRpy(rotation)))
        SubElement(element, "parent", link=parent)
        SubElement(element, "child", link=name)
        SubElement(element, "axis", xyz="0 0 1")
        limits = {
            "lower": repr(joint.lower),
            "upper": repr(joint.upper),
            "velocity": repr(joint.velocity_limit),
            "effort": repr(float(joint.torque_limit)),
        }
        SubElement(element, "limit", limits)
        parent = name
    SubElement(robot, "link", name=arm.tip_frame)
    turn = rotation_from_quaternion(arm.tip_rotation)
    name = f"{arm.tip_frame}_joint"
    _fix(robot, name if name not in arm.joint_names else f"{name}_fixed", parent, arm.tip_frame, arm.tip_offset, turn)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _fix(robot: Element, name: str, parent: str, child: str, offset: Vector3, turn: Array) -> None:
    """Add a joint that does not move, with the place of the child, m, and its rotation (3, 3) in the parent."""
    joint = SubElement(robot, "joint", name=name, type="fixed")
    SubElement(joint, "origin", xyz=numbers(offset), rpy=numbers(pin.rpy.matrixToRpy(turn)))
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)


def _add_capsule(link: Element, capsule: Capsule) -> None:
    """Add a capsule as a cylinder and two spheres, which URDF supports, for both display and collision checking."""
    start, end = np.asarray(capsule.start, dtype=float), np.asarray(capsule.end, dtype=float)
    length = float(np.linalg.norm(end - start))
    direction = (end - start) / length
    yaw, pitch = math.atan2(direction[1], direction[0]), math.acos(float(np.clip(direction[2], -1, 1)))
    for kind in ("visual", "collision"):
        for center, shape in ((start, "sphere"), (end, "sphere"), ((start + end) / 2, "cylinder")):
            element = SubElement(link, kind)
            angles = (0.0, pitch, yaw) if shape == "cylinder" else (0.0, 0.0, 0.0)
            SubElement(element, "origin", xyz=numbers(center), rpy=numbers(angles))
            geometry = SubElement(element, "geometry")
            size = {"radius": repr(capsule.radius)}
            if shape == "cylinder":
                size["length"] = repr(length)
            SubElement(geometry, shape, size)
