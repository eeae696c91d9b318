"""Rigid bodies, and contact of the arm with itself, as MuJoCo's geometries and pairs."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, capsule_names, numbers
from contact_reach_ros.world.rigid import Environment, Plane

_CONTACT: dict[str, str] = {"condim": "3", "solref": "0.004 1.0", "solimp": "0.95 0.99 0.001 0.5 2.0"}
"""Critically damped within 4 ms, four steps of the simulation: some 100,000 N/m at the hand."""
_FRICTION = 0.5


def rigid_geoms(environment: Environment) -> list[Element]:
    """Static geometries that the arm's moving links touch, and nothing else does."""
    geoms = []
    for number, body in enumerate(environment):
        if isinstance(body, Plane):
            shape = {"type": "plane", "size": "0 0 1", "pos": numbers(body.point), "zaxis": numbers(body.normal)}
        else:
            x, y, z, w = body.orientation
            shape = {"type": "box", "size": numbers(body.half), "pos": numbers(body.center)}
            shape["quat"] = numbers((w, x, y, z))
        types = {"contype": str(OBSTACLE_CONTACT_TYPE), "conaffinity": str(ROBOT_CONTACT_TYPE), "priority": "1"}
        friction = {"friction": numbers((_FRICTION, 0.005, 0.0001))}
        geom = Element("geom", {"name": f"rigid_{number}", **shape, **types, **friction, **_CONTACT})
        geoms.append(geom)
    return geoms


def self_contacts(arm: Arm) -> list[Element]:
    """Contact between the arm's own capsules that can touch."""
    names = capsule_names(arm)
    friction = numbers((_FRICTION, _FRICTION, 0.005, 0.0001, 0.0001))
    return [
        Element("pair", {"geom1": names[first], "geom2": names[second], "friction": friction, **_CONTACT})
        for first, second in self_pairs(arm)
    ]
