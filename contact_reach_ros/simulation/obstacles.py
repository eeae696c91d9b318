"""The obstacles as bodies of the simulation: spheres that touch the arm, but not each other."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, numbers
from contact_reach_ros.world.obstacle import Obstacle

_IMPEDANCE = 0.2
"""Impedance d of MuJoCo's contact constraints. They act like a spring that also has to move d / (1 - d) times the
effective mass: nine times that of the obstacle with the default of 0.9, so that forces lag behind the penetration."""
_CONTACT_DAMPING = 10.0
"""N s/m."""
_FIXED_MASS = 0.01
"""What fixed spheres have in their contacts for a mass, kg: so little that the arm's does not count."""

SPARE_NAME = "spare"
SPARE_PLACE = (0.0, 0.0, -100.0)
"""Position of the spare obstacle where nothing touches it, m."""
_SPARE_FRICTION = 0.2


def obstacle_bodies(obstacle: Obstacle, scale: float = 1.0) -> list[Element]:
    """Make a sphere for each of an obstacle's, without the springs of its edges.

    Movable ones are on three sprung sliders. All stiffnesses are multiplied by `scale`.
    """
    material = obstacle.material
    bodies = []
    for number, (position, fixed) in enumerate(zip(obstacle.rest, obstacle.fixed, strict=True)):
        name = f"{obstacle.kind}_{obstacle.id}_{number}"
        if fixed:
            body = Element("body", name=name, pos=numbers(position))
        else:
            body = _slider_body(name, position, material.damping, scale * material.stiffness)
        contact = _contact(scale * material.contact_stiffness, _FIXED_MASS if fixed else material.mass)
        body.append(_sphere(name, obstacle.radius, material.mass, material.friction, contact))
        bodies.append(body)
    return bodies


def spare_body() -> Element:
    """A rigid sphere out of reach that can be placed anywhere while the simulation runs."""
    body = Element("body", name=SPARE_NAME, pos=numbers(SPARE_PLACE), mocap="true")
    body.append(_sphere(SPARE_NAME, 0.05, 0.0, _SPARE_FRICTION, fixed_contact(1000.0)))
    return body


def fixed_contact(stiffness: float) -> tuple[float, float]:
    """MuJoCo's `solref` for a contact of this stiffness, N/m, with a fixed sphere, see `soften_fixed`."""
    return _contact(stiffness, _FIXED_MASS)


def soften_fixed(model: mujoco.MjModel) -> None:
    """Give fixed spheres the contact stiffness that they were declared with; `mj_setConst` undoes this.

    MuJoCo derives a contact's stiffness from the masses that can move. With a sphere that cannot, that of the arm would
    decide, and contact at the forearm would be ten times as stiff as at the hand.
    """
    for geom in np.flatnonzero(model.geom_contype == OBSTACLE_CONTACT_TYPE):
        body = model.geom_bodyid[geom]
        is_sphere = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        if is_sphere and not model.body_dofnum[body]:
            model.body_invweight0[body, 0] = 1.0 / _FIXED_MASS


def _contact(stiffness: float, mass: float) -> tuple[float, float]:
    # MuJoCo multiplies a contact's stiffness by the effective mass, which the sphere's dominates, and divides it by
    # 1 - d.
    scale = (1.0 - _IMPEDANCE) / mass
    return -stiffness * scale, -_CONTACT_DAMPING * scale


def _slider_body(name: str, position: NDArray[np.float64], damping: float, stiffness: float) -> Element:
    # The support of the obstacle is not simulated, and neither is gravity on it.
    body = Element("body", name=name, pos=numbers(position), gravcomp="1")
    for axis in ("1 0 0", "0 1 0", "0 0 1"):
        SubElement(
            body, "joint", {"type": "slide", "axis": axis, "stiffness": repr(stiffness), "damping": repr(damping)}
        )
    return body


def _sphere(name: str, radius: float, mass: float, friction: float, contact: tuple[float, float]) -> Element:
    return Element(
        "geom",
        name=name,
        type="sphere",
        size=repr(radius),
        mass=repr(mass),
        contype=str(OBSTACLE_CONTACT_TYPE),
        conaffinity=str(ROBOT_CONTACT_TYPE),
        condim="3" if friction > 0.0 else "1",
        friction=numbers((max(friction, 1e-5), 0.005, 0.0001)),
        priority="1",
        solref=numbers(contact),
        solimp=numbers((_IMPEDANCE, _IMPEDANCE, 0.001, 0.5, 2)),
    )
