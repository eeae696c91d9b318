"""The capsules of an arm that is read from a URDF: given ones, or those around its collision geometry."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull, QhullError

from contact_reach_ros.arm.arm import Capsule, Joint, Vector3
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import Fit, fit_capsule
from contact_reach_ros.arm.kinematics import rotation_about, rotation_from_quaternion
from contact_reach_ros.arm.robot_file import POINTS, find_mesh
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.errors import SettingsError

_SWEEP = 12
"""Angles of the first joint at which its link is part of the base's capsule."""
_WIDE = 1.3
"""Factor on the radius of the base's capsule up to which the swept first link belongs to it."""
_RIM = 24
"""Points on the rim of a cylinder; their polygon is around the circle."""


class Part(NamedTuple):
    """A moving link, or the base, with all links that are fixed to it."""

    link: str
    turn: pin.SE3
    """Frame that turns about its z axis, in the link's frame."""
    places: dict[str, pin.SE3]
    """Frames of the link and of those that are fixed to it, in the turned frame."""


class LinkCapsules(NamedTuple):
    """Capsules of base and links, and how they were found."""

    base: Capsule
    links: tuple[Capsule, ...]
    fits: dict[str, Fit]
    """Those that were fitted, by link."""
    bare: list[str]
    """Moving links without collision geometry, which have none."""


def link_capsules(
    links: Mapping[str, Element], file: Path, options: ArmOptions, parts: Sequence[Part], first: Joint
) -> LinkCapsules:
    """Find the capsules of the base and the moving links: given ones, or one around all collision geometry of a link.

    The base's stands upright. A first link that only turns about the base's axis is part of it, unless that would make
    it much wider.

    Parameters
    ----------
    links, file, options
        Links of the URDF by name, its path, and what it leaves open.
    parts
        The base, then the moving links.
    first
        The first joint.

    Raises
    ------
    SettingsError
        If a mesh cannot be read, or the base or all moving links have neither collision geometry nor given capsules.
    """
    given = [_given(options, number, part) for number, part in enumerate(parts)]
    shapes = [
        _part_balls(links, file, options, part) if own is None else np.zeros((0, 4))
        for own, part in zip(given, parts, strict=True)
    ]
    fits: dict[str, Fit] = {}
    begin, base = 1, given[0][0] if given[0] else None
    if base is None:
        upright = np.array([0.0, 0.0, 1.0])
        fit = fit_capsule(shapes[0], upright) if len(shapes[0]) else None
        swept = _swept(first, shapes[1])
        if len(swept):
            wide = fit_capsule(np.concatenate([shapes[0], swept]), upright)
            if fit is None or wide.radius <= _WIDE * fit.radius:
                begin, fit = 2, wide
        if fit is None:
            raise SettingsError(
                f"{file}: base '{parts[0].link}' has no collision geometry; expected some in the URDF, or a capsule "
                f"under capsules ({{{parts[0].link}: [{{start: ..., end: ..., radius: ...}}]}})"
            )
        fits[parts[0].link], base = fit, _capsule(0, fit)
    capsules: list[Capsule] = []
    bare = []
    for number in range(begin, len(parts)):
        own, link = given[number], parts[number].link
        if own is not None:
            capsules += own
        elif len(shapes[number]):
            fits[link] = fit_capsule(shapes[number])
            capsules.append(_capsule(number, fits[link]))
        else:
            bare.append(link)
    if not capsules:
        raise SettingsError(
            f"{file}: no moving link has collision geometry; expected some in the URDF, or some under capsules"
        )
    return LinkCapsules(base, tuple(capsules), fits, bare)


def vector(values: Array) -> Vector3:
    """Three numbers as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _given(options: ArmOptions, number: int, part: Part) -> list[Capsule] | None:
    """The capsules of a part that the options have, in its turned frame; None if they say nothing about it."""
    found = None
    for name, place in part.places.items():
        if name in options.capsules:
            found = found or []
            for each in options.capsules[name]:
                start, end = (vector(place.act(np.array(point))) for point in (each.start, each.end))
                found.append(Capsule(number, start, end, each.radius))
    return found


def _part_balls(links: Mapping[str, Element], file: Path, options: ArmOptions, part: Part) -> Array:
    """Balls (N, 4) whose convex hulls cover the collision shapes of a part, in its turned frame."""
    found = [np.zeros((0, 4))]
    for name, place in part.places.items():
        where = f"{file}: link '{name}'"
        for element in links[name].findall("collision"):
            at = place * placement(element.find("origin"))
            for shape in element.findall("geometry/*"):
                balls = _mesh_balls(shape, file, options, where) if shape.tag == "mesh" else _balls(shape, where)
                found.append(_moved(balls, at.rotation, at.translation))
    return np.concatenate(found)


def placement(origin: Element | None) -> pin.SE3:
    """Where an <origin> places something; at the frame itself without one."""
    if origin is None:
        return pin.SE3.Identity()
    return pin.SE3(pin.rpy.rpyToMatrix(_numbers(origin, "rpy", "0 0 0")), _numbers(origin, "xyz", "0 0 0"))


def _balls(shape: Element, where: str) -> Array:
    """Centres and radii (N, 4), m, of balls whose convex hull covers a box, cylinder, sphere or capsule."""
    sizes = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
    if shape.tag == POINTS:
        return _with_radius(_numbers(shape, "at").reshape(-1, 3), 0.0)
    if shape.tag not in sizes:
        raise SettingsError(
            f"{where}: collision: geometry <{shape.tag}> is unknown; expected box, cylinder, sphere, capsule or mesh"
        )
    for key in sizes[shape.tag]:
        if key not in shape.attrib:
            raise SettingsError(f"{where}: collision: {shape.tag} has no {key}; expected one, m")
    if shape.tag == "box":
        corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
        return _with_radius(corners * _numbers(shape, "size"), 0.0)
    radius = float(shape.get("radius", ""))
    if shape.tag == "sphere":
        return _with_radius(np.zeros((1, 3)), radius)
    length = float(shape.get("length", ""))
    ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
    if shape.tag == "capsule":
        return _with_radius(ends, radius)
    angles = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1) * radius / np.cos(np.pi / _RIM)
    return _with_radius(np.concatenate([rim + end for end in ends]), 0.0)


def _mesh_balls(shape: Element, urdf: Path, options: ArmOptions, where: str) -> Array:
    """The outer vertices of a mesh as balls (N, 4) without a radius, m."""
    name = shape.get("filename", "")
    path = find_mesh(name, urdf, options.packages)
    mend = "give the folder of its package under packages, or the link's capsules under capsules ([] for none)"
    if path is None:
        raise SettingsError(f"{where}: mesh '{name}' is not found; {mend}")
    try:
        scale = _unit(path) * _numbers(shape, "scale", "1 1 1")
        vertices = np.array(coal.MeshLoader(coal.NODE_TYPE.BV_AABB).load(str(path), scale).vertices())
        outer = vertices[ConvexHull(vertices).vertices]
    except QhullError:
        # A flat one: all of it is outside.
        outer = vertices
    except (ValueError, RuntimeError, ElementTree.ParseError) as error:
        raise SettingsError(f"{where}: mesh '{path}' cannot be read; expected a file with triangles; {mend}") from error
    return _with_radius(np.unique(outer, axis=0), 0.0)


def _unit(mesh: Path) -> float:
    """Metres in a unit of a mesh, which COLLADA files give and coal leaves aside."""
    unit = ElementTree.parse(mesh).find("{*}asset/{*}unit") if mesh.suffix.lower() == ".dae" else None
    return 1.0 if unit is None else float(unit.get("meter", "1"))


def _numbers(element: Element, key: str, default: str = "") -> Array:
    return np.array(element.get(key, default).split(), float)


def _with_radius(points: Array, radius: float) -> Array:
    return np.column_stack([points, np.full(len(points), radius)])


def _moved(balls: Array, rotation: Array, offset: Array) -> Array:
    return np.column_stack([balls[:, :3] @ rotation.T + offset, balls[:, 3]])


def _swept(first: Joint, balls: Array) -> Array:
    """The first link's balls at all angles of its joint, in the base's frame; none if it turns about another axis."""
    at_zero = rotation_from_quaternion(first.rotation)
    if at_zero[2, 2] < 1.0 - 1e-9 or math.hypot(*first.offset[:2]) > 1e-6:
        return balls[:0]
    turns = [rotation_about((0.0, 0.0, 1.0), angle) for angle in np.linspace(0.0, 2.0 * np.pi, _SWEEP, endpoint=False)]
    return np.concatenate([_moved(balls, at_zero @ turn, np.array(first.offset)) for turn in turns])


def _capsule(link: int, fit: Fit) -> Capsule:
    """In tenths of a millimetre; what fits stays inside."""
    start, end = (vector(np.round(point, 4)) for point in (fit.start, fit.end))
    return Capsule(link, start, end, round(math.ceil(1e4 * fit.radius) / 1e4 + 1e-4, 4))
