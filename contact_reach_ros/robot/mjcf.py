"""The arm as MJCF, the one file that MuJoCo, Brax and Pinocchio read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.iiwa14 import Capsule
from contact_reach_ros.robot.kinematics import link_inertias

ROBOT_CONTACT_TYPE = 1
OBSTACLE_CONTACT_TYPE = 2
"""Robot and obstacles touch each other; neither touches itself."""

PAYLOAD_CENTER = (0.0, 0.0, 0.05)
"""Where the mass at the flange is, in the flange's frame, m."""
PAYLOAD_INERTIA = 1e-3
"""Of the mass at the flange about its centre, for each kg, m²."""


def numbers(values: Iterable[float]) -> str:
    """Values as an XML attribute, in full precision."""
    return " ".join(repr(float(value)) for value in values)


def build_mjcf(inertia_set: str = "nominal", obstacles: Sequence[Element] = (), payload: float = 0.0) -> str:
    """Build the MJCF text of the arm.

    Parameters
    ----------
    inertia_set
        One of `iiwa14.INERTIA_SETS`.
    obstacles
        Bodies to add to the world.
    payload
        Mass at the flange, kg; zero adds nothing.

    Raises
    ------
    SettingsError
        If the inertia set is unknown.
    """
    root = Element("mujoco", model="iiwa14")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    # Brax reads Euler models only; the plant takes its step and integrator from its own settings.
    SubElement(root, "option", timestep="0.001", integrator="Euler")
    world = SubElement(root, "worldbody")
    body = SubElement(world, "body", name=iiwa14.BASE_NAME)
    body.append(_capsule(iiwa14.BASE_CAPSULE))
    inertias = link_inertias(inertia_set)
    for number, (joint, link, inertia) in enumerate(zip(iiwa14.JOINTS, iiwa14.LINK_NAMES, inertias, strict=True), 1):
        body = SubElement(body, "body", name=link, pos=numbers(joint.offset), quat=numbers(joint.rotation))
        SubElement(
            body,
            "inertial",
            mass=repr(inertia.mass),
            pos=numbers(inertia.center),
            fullinertia=numbers(inertia.tensor),
        )
        SubElement(
            body,
            "joint",
            name=joint.name,
            axis="0 0 1",
            range=numbers((-joint.position_limit, joint.position_limit)),
            armature=repr(iiwa14.ARMATURE),
        )
        for capsule in iiwa14.CAPSULES:
            if capsule.link == number:
                body.append(_capsule(capsule))
    flange = SubElement(body, "body", name=iiwa14.FLANGE_NAME, pos=numbers(iiwa14.FLANGE_OFFSET))
    SubElement(flange, "site", name="flange")
    if payload > 0.0:
        diagonal = numbers([PAYLOAD_INERTIA * payload] * 3)
        SubElement(flange, "inertial", mass=repr(payload), pos=numbers(PAYLOAD_CENTER), diaginertia=diagonal)
    world.extend(obstacles)
    actuators = SubElement(root, "actuator")
    for joint in iiwa14.JOINTS:
        limit = numbers((-joint.torque_limit, joint.torque_limit))
        SubElement(actuators, "motor", name=joint.name, joint=joint.name, ctrlrange=limit)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _capsule(capsule: Capsule) -> Element:
    """Collision geometry of one link; its mass is in the link's inertial element."""
    return Element(
        "geom",
        name=f"capsule_{capsule.link}",
        type="capsule",
        fromto=numbers((*capsule.start, *capsule.end)),
        size=repr(capsule.radius),
        mass="0",
        contype=str(ROBOT_CONTACT_TYPE),
        conaffinity=str(OBSTACLE_CONTACT_TYPE),
    )
