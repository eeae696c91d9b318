"""The obstacles as bodies of the simulation: spheres that touch the arm, but not each other."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, numbers
from contact_reach_ros.scenes.scene import Ball, BallSettings, Wall, WallSettings

_IMPEDANCE = 0.2
"""Of MuJoCo's contact constraints. They act like a spring that has to move a mass of d / (1 - d) times the effective
one besides: nine times that of the obstacle with the default of 0.9, so that forces lag behind the penetration."""
_CONTACT_DAMPING = 10.0
"""N s/m."""
_ARM_MASS = 3.0
"""Effective mass of the arm where it touches something that cannot move, roughly, kg."""

SPARE_NAME = "spare"
SPARE_PLACE = (0.0, 0.0, -100.0)
"""Where nothing touches the spare obstacle, m."""


def ball_body(index: int, ball: Ball, scale: float = 1.0) -> Element:
    """A sphere on three sprung sliders, with all stiffnesses multiplied by `scale`."""
    settings = ball.settings
    body = _slider_body(f"ball_{index}", ball.center, settings.damping, scale * settings.stiffness)
    body.append(_sphere(body, settings.radius, settings.mass, settings, settings.mass, scale))
    return body


def wall_bodies(index: int, wall: Wall, scale: float = 1.0) -> list[Element]:
    """One small sphere for each node; those that can move on three sliders, without the springs of the edges.

    All stiffnesses are multiplied by `scale`.
    """
    settings = wall.settings
    bodies = []
    for number, (position, fixed) in enumerate(zip(wall.rest, wall.fixed, strict=True)):
        name = f"wall_{index}_{number}"
        if fixed:
            body = Element("body", name=name, pos=numbers(position))
        else:
            body = _slider_body(name, position, settings.damping, scale * settings.anchor_stiffness)
        effective_mass = _ARM_MASS if fixed else settings.node_mass
        body.append(_sphere(body, settings.node_radius, settings.node_mass, settings, effective_mass, scale))
        bodies.append(body)
    return bodies


def spare_body() -> Element:
    """A sphere out of reach that does not give way and can be put anywhere while the simulation runs."""
    body = Element("body", name=SPARE_NAME, pos=numbers(SPARE_PLACE), mocap="true")
    material = WallSettings()
    body.append(_sphere(body, 0.05, 0.0, material, _ARM_MASS, 1.0))
    return body


def fixed_contact(stiffness: float) -> tuple[float, float]:
    """MuJoCo's `solref` for a contact of this stiffness, N/m, with something that does not give way."""
    scale = (1.0 - _IMPEDANCE) / _ARM_MASS
    return -stiffness * scale, -_CONTACT_DAMPING * scale


def _slider_body(name: str, position: NDArray[np.float64], damping: float, stiffness: float) -> Element:
    # What carries the obstacle is not simulated, so gravity is not simulated on it.
    body = Element("body", name=name, pos=numbers(position), gravcomp="1")
    for axis in ("1 0 0", "0 1 0", "0 0 1"):
        SubElement(
            body, "joint", {"type": "slide", "axis": axis, "stiffness": repr(stiffness), "damping": repr(damping)}
        )
    return body


def _sphere(
    body: Element,
    radius: float,
    mass: float,
    material: BallSettings | WallSettings,
    effective_mass: float,
    stiffness_scale: float,
) -> Element:
    # MuJoCo multiplies a contact's stiffness by the effective mass, which the lighter partner dominates, and divides it
    # by 1 - d.
    scale = (1.0 - _IMPEDANCE) / effective_mass
    stiffness = stiffness_scale * material.contact_stiffness
    friction = material.friction
    return Element(
        "geom",
        name=body.attrib["name"],
        type="sphere",
        size=repr(radius),
        mass=repr(mass),
        contype=str(OBSTACLE_CONTACT_TYPE),
        conaffinity=str(ROBOT_CONTACT_TYPE),
        condim="3" if friction > 0.0 else "1",
        friction=numbers((max(friction, 1e-5), 0.005, 0.0001)),
        priority="1",
        solref=numbers((-stiffness * scale, -_CONTACT_DAMPING * scale)),
        solimp=numbers((_IMPEDANCE, _IMPEDANCE, 0.001, 0.5, 2)),
    )
