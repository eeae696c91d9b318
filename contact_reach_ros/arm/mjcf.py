"""The arm as MJCF, the one format that MuJoCo, Brax and Pinocchio all read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from contact_reach_ros.arm.arm import Arm, Capsule

ROBOT_CONTACT_TYPE = 1
OBSTACLE_CONTACT_TYPE = 2
"""Contact type with which robot and obstacles touch each other, and neither itself, except for listed pairs."""

_WORLD = "world"
"""Name that MuJoCo keeps for the world itself, and that URDFs like to give to the base."""
TIP_SITE = "flange"
"""Name of the site at the tip, which the last link carries."""

PAYLOAD_CENTER = (0.0, 0.0, 0.05)
"""Position of the payload in the flange's frame, m."""
PAYLOAD_INERTIA = 1e-3
"""Inertia of the payload about its centre, per kg of its mass, m²."""


def numbers(values: Iterable[float]) -> str:
    """Values as an XML attribute, in full precision."""
    return " ".join(repr(float(value)) for value in values)


def capsule_names(arm: Arm) -> tuple[str, ...]:
    """Names of the geometries of base and links, in the order of `capsules.shapes`."""
    links = [capsule.link for capsule in (*arm.base_capsules, *arm.capsules)]
    counts = (links[:index].count(link) for index, link in enumerate(links))
    return tuple(f"capsule_{link}_{count}".removesuffix("_0") for link, count in zip(links, counts, strict=True))


def build_mjcf(
    arm: Arm,
    inertia_set: str = "nominal",
    obstacles: Sequence[Element] = (),
    payload: float = 0.0,
    contacts: Sequence[Element] = (),
    fields: Mapping[str, Iterable[float]] | None = None,
) -> str:
    """Build the MJCF text of an arm.

    Raises `SettingsError` if the inertia set is unknown.

    Parameters
    ----------
    arm
        Arm to build.
    inertia_set
        One of the arm's inertia sets.
    obstacles
        Bodies and geometries to add to the world.
    payload
        Mass at the flange, kg; zero adds nothing.
    contacts
        Pairs of geometries that touch although their types would not.
    fields
        Custom fields by name.
    """
    root = Element("mujoco", model=arm.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    # Brax reads only models with the Euler integrator; the plant sets step and integrator itself.
    SubElement(root, "option", timestep="0.001", integrator="Euler", gravity=numbers(arm.gravity))
    world = SubElement(root, "worldbody")
    body = SubElement(world, "body", name=arm.base_frame if arm.base_frame != _WORLD else f"the {_WORLD}")
    named = list(zip((*arm.base_capsules, *arm.capsules), capsule_names(arm), strict=True))
    body.extend(_capsule(capsule, geom) for capsule, geom in named if capsule.link == 0)
    inertias = arm.inertias(inertia_set)
    for number, (joint, link, inertia) in enumerate(zip(arm.joints, arm.link_names, inertias, strict=True), 1):
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
            range=numbers((joint.lower, joint.upper)),
            armature=repr(joint.armature),
        )
        body.extend(_capsule(capsule, geom) for capsule, geom in named if capsule.link == number)
    # Not in the tip's body: Brax, which fuses bodies without joints, would round it.
    place = {"pos": numbers(arm.tip_offset), "quat": numbers(arm.tip_rotation)}
    SubElement(body, "site", place, name=TIP_SITE)
    flange = SubElement(body, "body", place, name=arm.tip_frame)
    if payload > 0.0:
        diagonal = numbers([PAYLOAD_INERTIA * payload] * 3)
        SubElement(flange, "inertial", mass=repr(payload), pos=numbers(PAYLOAD_CENTER), diaginertia=diagonal)
    world.extend(obstacles)
    if contacts:
        SubElement(root, "contact").extend(contacts)
    actuators = SubElement(root, "actuator")
    for joint in arm.joints:
        limit = numbers((-joint.torque_limit, joint.torque_limit))
        SubElement(actuators, "motor", name=joint.name, joint=joint.name, ctrlrange=limit)
    if fields:
        custom = SubElement(root, "custom")
        for name, values in fields.items():
            SubElement(custom, "numeric", name=name, data=numbers(values))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _capsule(capsule: Capsule, name: str) -> Element:
    """Collision geometry of one link; the link's inertial element holds the mass."""
    return Element(
        "geom",
        name=name,
        type="capsule",
        fromto=numbers((*capsule.start, *capsule.end)),
        size=repr(capsule.radius),
        mass="0",
        contype=str(ROBOT_CONTACT_TYPE),
        conaffinity=str(OBSTACLE_CONTACT_TYPE),
    )
