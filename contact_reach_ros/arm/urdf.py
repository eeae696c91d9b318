"""The arm as URDF, published as `robot_description` for RViz, tf and other ROS tools."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Arm, Capsule, Inertia
from contact_reach_ros.arm.mjcf import numbers
from contact_reach_ros.arm.mount import scene_frame, tilt
from contact_reach_ros.arm.rotations import frame_about, rotation_from_quaternion
from contact_reach_ros.arm.urdf_tree import LIMITS, TENSOR


def build_urdf(arm: Arm) -> str:
    """Build the URDF text of an arm, with the same link frames as the MJCF.

    Readers of URDFs let gravity act along -z of the root. That is the base, or for a tilted one a link without a shape
    that the base is fixed to.
    """
    robot = Element("robot", name=arm.name)
    parent = arm.base_frame
    if tilt(arm):
        root = f"{parent}_upright"
        SubElement(robot, "link", name=root)
        upright = scene_frame(arm).rotation.T
        add_joint(robot, f"{parent}_mount", "fixed", (root, parent), pin.SE3(upright, np.zeros(3)))
    base = SubElement(robot, "link", name=parent)
    for capsule in arm.base_capsules:
        _add_capsule(base, capsule)
    for number, (joint, name, inertia) in enumerate(zip(arm.joints, arm.link_names, arm.inertias(), strict=True), 1):
        link = SubElement(robot, "link", name=name)
        add_inertial(link, inertia)
        for capsule in arm.capsules:
            if capsule.link == number:
                _add_capsule(link, capsule)
        place = pin.SE3(rotation_from_quaternion(joint.rotation), np.array(joint.offset, float))
        element = add_joint(robot, joint.name, "revolute", (parent, name), place)
        SubElement(element, "axis", xyz="0 0 1")
        limits = joint.lower, joint.upper, joint.velocity_limit, float(joint.torque_limit)
        SubElement(element, "limit", dict(zip(LIMITS, map(repr, limits), strict=True)))
        parent = name
    SubElement(robot, "link", name=arm.tip_frame)
    place = pin.SE3(rotation_from_quaternion(arm.tip_rotation), np.array(arm.tip_offset, float))
    name = f"{arm.tip_frame}_joint"
    name = name if name not in arm.joint_names else f"{name}_fixed"
    add_joint(robot, name, "fixed", (parent, arm.tip_frame), place)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def add_joint(robot: Element, name: str, kind: str, links: tuple[str, str], place: pin.SE3) -> Element:
    """Add a joint between two links, with the place of the second in the first."""
    joint = SubElement(robot, "joint", name=name, type=kind)
    add_origin(joint, place)
    SubElement(joint, "parent", link=links[0])
    SubElement(joint, "child", link=links[1])
    return joint


def add_inertial(link: Element, inertia: Inertia) -> None:
    """Add mass and inertia to a link."""
    inertial = SubElement(link, "inertial")
    add_origin(inertial, pin.SE3(np.eye(3), np.array(inertia.center, float)))
    SubElement(inertial, "mass", value=repr(inertia.mass))
    SubElement(inertial, "inertia", dict(zip(TENSOR, map(repr, inertia.tensor), strict=True)))


def add_origin(element: Element, place: pin.SE3) -> None:
    """Say where something is."""
    SubElement(element, "origin", xyz=numbers(place.translation), rpy=numbers(pin.rpy.matrixToRpy(place.rotation)))


def _add_capsule(link: Element, capsule: Capsule) -> None:
    """Add a capsule as a cylinder and two spheres, which URDF supports, for both display and collision checking."""
    start, end = np.array(capsule.start, float), np.array(capsule.end, float)
    size = {"radius": repr(capsule.radius)}
    shapes = (
        (start, "sphere", size),
        (end, "sphere", size),
        ((start + end) / 2, "cylinder", {**size, "length": repr(float(np.linalg.norm(end - start)))}),
    )
    for kind in ("visual", "collision"):
        for center, shape, sizes in shapes:
            element = SubElement(link, kind)
            add_origin(element, pin.SE3(frame_about(end - start), center))
            SubElement(SubElement(element, "geometry"), shape, sizes)
