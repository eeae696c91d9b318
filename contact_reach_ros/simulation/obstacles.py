"""What the arm can touch, as MuJoCo's bodies: soft spheres with springs between them, rigid bodies, and itself.

Obstacles do not touch each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.capsules import self_pairs
from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, capsule_names, numbers
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.rigid import Environment, Plane

_IMPEDANCE = 0.2
"""Impedance d of MuJoCo's contact constraints. They act like a spring that also has to move d / (1 - d) times the
effective mass: nine times that of the obstacle with the default of 0.9, so that forces lag behind the penetration."""
_CONTACT_DAMPING = 10.0
"""N s/m."""
_FIXED_MASS = 0.01
"""What fixed spheres have in their contacts for a mass, kg: so little that the arm's does not count."""

_RELAXATION = 0.02
"""Damping of a stem's joint over its stiffness, s: the time in which a bent stem returns."""
BEND_LIMIT = 0.8
"""Greatest bend at such a joint, rad."""

_RIGID: dict[str, str] = {"condim": "3", "solref": "0.004 1.0", "solimp": "0.95 0.99 0.001 0.5 2.0"}
"""Critically damped within 4 ms, four steps of the simulation: some 100,000 N/m at the hand."""
_RIGID_FRICTION = 0.5


def obstacle_bodies(obstacle: Obstacle, index: int, scale: float) -> list[Element]:
    """Make a sphere for each of those of the obstacle with this index in the scene, without the springs of its edges.

    Movable ones are on three sprung sliders. All stiffnesses are multiplied by `scale`.
    """
    if obstacle.bending is not None:
        return _stems(obstacle, index, scale)
    material = obstacle.material
    bodies = []
    for number, (position, fixed) in enumerate(zip(obstacle.rest, obstacle.fixed, strict=True)):
        name = f"{obstacle.kind}_{index}_{number}"
        if fixed:
            body = Element("body", name=name, pos=numbers(position))
        else:
            body = _slider_body(name, position, material.damping, scale * material.stiffness)
        contact = _contact(scale * material.contact_stiffness, _FIXED_MASS if fixed else material.mass)
        body.append(_sphere(name, obstacle.radius, material.mass, material.friction, contact))
        bodies.append(body)
    return bodies


def _stems(obstacle: Obstacle, index: int, scale: float) -> list[Element]:
    """The stems of a plant: chains of capsules on hinges, the first link of each fixed, with a site at each sphere."""
    bending, material, radius = obstacle.bending, obstacle.material, obstacle.radius
    assert bending is not None
    rigid, bodies = _contact(scale * material.contact_stiffness, _FIXED_MASS), []
    bend = {
        "stiffness": repr(scale * bending.stiffness),
        "damping": repr(scale * _RELAXATION * bending.stiffness),
        "limited": "true",
        "range": numbers((-BEND_LIMIT, BEND_LIMIT)),
    }
    for stem, masses, fruit in zip(bending.stems, bending.masses, bending.fruits, strict=True):
        root, first = obstacle.rest[list(stem[:2])]
        joints = np.array([0.5 * (root + first), *obstacle.rest[list(stem[1:-1])]])
        name = f"{obstacle.kind}_{index}_{stem[1]}_root"
        parent = Element("body", name=name, pos=numbers(root))
        parent.append(_capsule(name, joints[0] - root, radius, 0.0, material.friction, rigid))
        bodies.append(parent)
        # Any two axes across the stem.
        across = np.linalg.svd((first - root)[None])[2][1:]
        for node, begin, at, mass in zip(stem[1:], np.vstack([root, joints]), joints, masses, strict=False):
            name, end = f"{obstacle.kind}_{index}_{node}", obstacle.rest[node] - at
            body = SubElement(parent, "body", name=name, pos=numbers(at - begin), gravcomp="1")
            for axis in across:
                SubElement(body, "joint", {"type": "hinge", "axis": numbers(axis), **bend})
            contact = _contact(scale * material.contact_stiffness, mass)
            body.append(_capsule(name, end, radius, mass, material.friction, contact))
            SubElement(body, "site", name=name, pos=numbers(end))
            parent = body
        if fruit:
            geom = {"type": "sphere", "size": "0.015", "contype": "0", "conaffinity": "0"}
            SubElement(parent, "geom", {**geom, "pos": numbers(end), "mass": repr(fruit)})
    return bodies


def _capsule(
    name: str, end: Array, radius: float, mass: float, friction: float, contact: tuple[float, float]
) -> Element:
    """A capsule from the origin of its body to `end` (3,), m."""
    geom = _sphere(name, radius, mass, friction, contact)
    geom.set("type", "capsule")
    geom.set("fromto", numbers((0.0, 0.0, 0.0, *end)))
    return geom


def soften_fixed(model: mujoco.MjModel) -> None:
    """Give fixed spheres the contact stiffness that they were declared with; `mj_setConst` undoes this.

    MuJoCo derives a contact's stiffness from the masses that can move. With a sphere that cannot, that of the arm would
    decide, and contact at the forearm would be ten times as stiff as at the hand.
    """
    for geom in np.flatnonzero(model.geom_contype == OBSTACLE_CONTACT_TYPE):
        body = model.geom_bodyid[geom]
        is_soft = mujoco.mjtGeom(model.geom_type[geom]) in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        if is_soft and not model.body_dofnum[body]:
            model.body_invweight0[body, 0] = 1.0 / _FIXED_MASS


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
        friction = {"friction": numbers((_RIGID_FRICTION, 0.005, 0.0001))}
        geom = Element("geom", {"name": f"rigid_{number}", **shape, **types, **friction, **_RIGID})
        geoms.append(geom)
    return geoms


def self_contacts(arm: Arm) -> list[Element]:
    """Contact between the arm's own capsules that can touch."""
    names = capsule_names(arm)
    friction = numbers((_RIGID_FRICTION, _RIGID_FRICTION, 0.005, 0.0001, 0.0001))
    return [
        Element("pair", {"geom1": names[first], "geom2": names[second], "friction": friction, **_RIGID})
        for first, second in self_pairs(arm)
    ]


class Foam:
    """Springs along the edges of all obstacles.

    Each is a spring joint as in the paper: it pulls the vector between its ends back to its value at rest, in all
    directions alike. Foam grows stiffer as it is squeezed, so the stiffness is k (1 + h (s / l)²), where the ends have
    moved apart or together by s, the spring is l long at rest and h is the hardening.
    """

    def __init__(self, obstacles: Sequence[Obstacle], scale: float = 1.0) -> None:
        """`scale`: factor on the stiffness of all springs."""
        # Imported where it is needed: a third of the start of a driver without foam.
        from scipy.sparse import csr_array

        rest = np.concatenate([obstacle.rest for obstacle in obstacles])
        free = ~np.concatenate([obstacle.fixed for obstacle in obstacles])
        first = np.cumsum([0, *(len(obstacle.rest) for obstacle in obstacles)])
        counts = [len(obstacle.edges) for obstacle in obstacles]
        edges = np.concatenate([obstacle.edges + start for obstacle, start in zip(obstacles, first, strict=False)])
        stiffness = np.repeat([scale * obstacle.material.edge_stiffness for obstacle in obstacles], counts)
        hardening = np.repeat([obstacle.material.hardening for obstacle in obstacles], counts)
        # An edge between two fixed spheres has no effect.
        kept = free[edges].any(axis=1)
        edges, stiffness, hardening = edges[kept], stiffness[kept], hardening[kept]
        self._count = int(free.sum())
        ends = np.where(free, np.cumsum(free) - 1, -1)[edges]
        rows, sides = np.nonzero(ends >= 0)
        self._stretch = csr_array(
            (np.where(sides == 0, 1.0, -1.0), (rows, ends[rows, sides])), shape=(len(edges), self._count)
        )
        """(E, M) matrix from the displacements of the movable spheres to the change of each edge's vector."""
        self._gather = csr_array(self._stretch.T)
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        self._stiffness = stiffness[:, None]
        self._slope = self._stiffness * (hardening / lengths**2)[:, None]

    def forces(self, displacements: Array) -> Array:
        """Forces on the movable spheres, (3 M,) N, at their displacements from rest, (3 M,) m."""
        change = self._stretch @ displacements.reshape(self._count, 3)
        square = np.einsum("ij,ij->i", change, change)[:, None]
        return -(self._gather @ ((self._stiffness + self._slope * square) * change)).ravel()


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
