"""The arm as URDF, published as `robot_description` for RViz, tf and other ROS tools."""

from __future__ import annotations

import math
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.iiwa14 import Capsule
from contact_reach_ros.robot.kinematics import Array, link_inertias, rotation_from_quaternion
from contact_reach_ros.robot.mjcf import numbers


def roll_pitch_yaw(rotation: Array) -> tuple[float, float, float]:
    """Fixed-axis angles of a rotation matrix (3, 3), as URDF writes them, rad."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[2, 1], rotation[2, 2]))
    if math.hypot(rotation[2, 1], rotation[2, 2]) < 1e-9:
        return math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0
    return math.atan2(rotation[2, 1], rotation[2, 2]), pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def build_urdf(inertia_set: str = "nominal") -> str:
    """Build the URDF text of the arm, with the same link frames as the MJCF.

    Raises
    ------
    SettingsError
        If the inertia set is unknown.
    """
    robot = Element("robot", name="iiwa14")
    base = SubElement(robot, "link", name=iiwa14.BASE_NAME)
    _add_capsule(base, iiwa14.BASE_CAPSULE)
    parent = iiwa14.BASE_NAME
    inertias = link_inertias(inertia_set)
    for number, (joint, name, inertia) in enumerate(zip(iiwa14.JOINTS, iiwa14.LINK_NAMES, inertias, strict=True), 1):
        link = SubElement(robot, "link", name=name)
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=numbers(inertia.center), rpy="0 0 0")
        SubElement(inertial, "mass", value=repr(inertia.mass))
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        SubElement(inertial, "inertia", {key: repr(value) for key, value in zip(keys, inertia.tensor, strict=True)})
        for capsule in iiwa14.CAPSULES:
            if capsule.link == number:
                _add_capsule(link, capsule)
        element = SubElement(robot, "joint", name=joint.name, type="revolute")
        rotation = rotation_from_quaternion(joint.rotation)
        SubElement(element, "origin", xyz=numbers(joint.offset), rpy=numbers(roll_pitch_yaw(rotation)))
        SubElement(element, "parent", link=parent)
        SubElement(element, "child", link=name)
        SubElement(element, "axis", xyz="0 0 1")
        limits = {
            "lower": repr(-joint.position_limit),
            "upper": repr(joint.position_limit),
            "velocity": repr(joint.velocity_limit),
            "effort": repr(float(joint.torque_limit)),
        }
        SubElement(element, "limit", limits)
        parent = name
    SubElement(robot, "link", name=iiwa14.FLANGE_NAME)
    flange = SubElement(robot, "joint", name=f"{iiwa14.FLANGE_NAME}_joint", type="fixed")
    SubElement(flange, "origin", xyz=numbers(iiwa14.FLANGE_OFFSET), rpy="0 0 0")
    SubElement(flange, "parent", link=parent)
    SubElement(flange, "child", link=iiwa14.FLANGE_NAME)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _add_capsule(link: Element, capsule: Capsule) -> None:
    """A capsule as cylinder and two spheres, which URDF knows, for both seeing and collision checking."""
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
