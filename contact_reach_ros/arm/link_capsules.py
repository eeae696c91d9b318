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
from contact_reach_ros.arm.capsule_fit import POOR, Fit, cover, fit_capsule
from contact_reach_ros.arm.kinematics import rotation_from_quaternion
from contact_reach_ros.arm.robot_file import POINTS, find_mesh
from contact_reach_ros.arm.table import ArmOptions, GivenCapsule
from contact_reach_ros.errors import SettingsError

_RIM = 128
"""Points on the rim of a cylinder, of which they leave 0.03 % of the radius outside."""


class Part(NamedTuple):
    """A moving link, or the base, with all links that are fixed to it."""

    link: str
    turn: pin.SE3
    """Frame that turns about its z axis, in the link's frame."""
    places: dict[str, pin.SE3]
    """Frames of the link and of those that are fixed to it, in the turned frame."""


class LinkCapsules(NamedTuple):
    """Capsules of base and links, and how they were found."""

    base: tuple[Capsule, ...]
    links: tuple[Capsule, ...]
    fits: dict[str, Fit]
    """Those that were fitted, by link; the worst of several."""
    bare: list[str]
    """Moving links without collision geometry, which have none, and the base if nothing that is fixed to it has any."""


def link_capsules(
    links: Mapping[str, Element], file: Path, options: ArmOptions, parts: Sequence[Part], first: Joint
) -> LinkCapsules:
    """Find the capsules of the base and the moving links.

    Each fixed link has a capsule around its collision geometry, or several around a table or a platform, and each
    moving link one around its own and that of the links that are fixed to it; links with given capsules have these
    instead. The first link's belongs to the base if one around the joint's axis, which does not move, is no poor fit.

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
        If a mesh cannot be read, or no moving link has collision geometry or given capsules.
    """
    base: list[Capsule] = []
    moving: list[Capsule] = []
    fits: dict[str, Fit] = {}
    bare = []
    for number, part in enumerate(parts):
        found = moving if number else base
        # By the link whose capsule is around them.
        balls: dict[str, list[Array]] = {}
        for link, place in part.places.items():
            if link in options.capsules:
                found += [_given(number, each, place, link, part) for each in options.capsules[link]]
            elif len(own := _link_balls(links[link], file, options, place, link)):
                balls.setdefault(part.link if number else link, []).append(own)
        for link, shapes in balls.items():
            around = np.concatenate(shapes)
            found_fits = [fit_capsule(around)] if number else cover(around)
            turning = fit_capsule(around, on_axis=True) if number == 1 else None
            if turning is not None and turning.volume_ratio <= max(POOR, found_fits[0].volume_ratio):
                found_fits = [turning]
                at = pin.SE3(rotation_from_quaternion(first.rotation), np.array(first.offset))
                base.append(_capsule(0, at.act(turning.start), at.act(turning.end), turning.radius, link))
            else:
                name = _fixed_name(number, link, part)
                found += [_capsule(number, fit.start, fit.end, fit.radius, name) for fit in found_fits]
            fits[link] = max(found_fits, key=lambda fit: fit.volume_ratio)
        if not balls and not options.capsules.keys() & part.places.keys():
            bare.append(part.link)
    if not moving:
        raise SettingsError(
            f"{file}: no moving link has collision geometry; expected some in the URDF, or some under capsules"
        )
    return LinkCapsules(tuple(base), tuple(moving), fits, bare)


def vector(values: Array) -> Vector3:
    """Three numbers as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _given(number: int, given: GivenCapsule, place: pin.SE3, link: str, part: Part) -> Capsule:
    start, end = (vector(place.act(np.array(point))) for point in (given.start, given.end))
    return Capsule(number, start, end, given.radius, _fixed_name(number, link, part))


def _fixed_name(number: int, link: str, part: Part) -> str:
    """Name of a capsule on a link that is fixed to the base; empty for the base's own and those of moving links."""
    return link if number == 0 and link != part.link else ""


def _link_balls(element: Element, file: Path, options: ArmOptions, place: pin.SE3, name: str) -> Array:
    """Balls (N, 4) whose convex hulls cover the collision shapes of a link at `place`."""
    found, where = [np.zeros((0, 4))], f"{file}: link '{name}'"
    for collision in element.findall("collision"):
        at = place * placement(collision.find("origin"))
        for shape in collision.findall("geometry/*"):
            balls = _mesh_balls(shape, file, options, where) if shape.tag == "mesh" else _balls(shape, where)
            found.append(np.column_stack([balls[:, :3] @ at.rotation.T + at.translation, balls[:, 3]]))
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
    rim = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1) * radius
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


def _capsule(link: int, start: Array, end: Array, radius: float, name: str) -> Capsule:
    """In tenths of a millimetre; what fits stays inside."""
    begins, ends = (vector(np.round(point, 4) + 0.0) for point in (start, end))
    return Capsule(link, begins, ends, round(math.ceil(1e4 * radius) / 1e4 + 1e-4, 4), name)
