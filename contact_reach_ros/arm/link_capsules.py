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

from contact_reach_ros.arm.arm import Capsule
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import POOR, Fit, cover, fit_capsule
from contact_reach_ros.arm.kinematics import vector
from contact_reach_ros.arm.robot_file import POINTS, find_mesh
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.arm.urdf_tree import placement, vector_in
from contact_reach_ros.errors import SettingsError

_RIM = 128
"""Points on the rim of a cylinder, of which they leave 0.03 % of the radius outside."""
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
"""Attributes of shapes."""


class Part(NamedTuple):
    """A moving link, or the base, with all links that are fixed to it."""

    link: str
    mount: pin.SE3
    """Its frame, turned so that the joint turns about z, in that of the part before; the base's is not turned."""
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


def link_capsules(links: Mapping[str, Element], file: Path, options: ArmOptions, parts: Sequence[Part]) -> LinkCapsules:
    """Find the capsules of the base and the moving links.

    Each fixed link has a capsule around its collision geometry, or several around a table or a platform, and each
    moving link one around its own and that of the links that are fixed to it; links with given capsules have these
    instead. The first link's belongs to the base if one around the joint's axis, which does not move, is no poor fit.

    Raises `SettingsError` if a mesh cannot be read, or no moving link has collision geometry or given capsules.

    Parameters
    ----------
    links, file, options
        Links of the URDF by name, its path, and what it leaves open.
    parts
        The base, then the moving links.
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
                for given in options.capsules[link]:
                    start, end = (vector(place.act(np.array(point))) for point in (given.start, given.end))
                    found.append(Capsule(number, start, end, given.radius, _name(link, part, number)))
            elif len(own := _link_balls(links[link], file, options, place, link)):
                balls.setdefault(part.link if number else link, []).append(own)
        for link, shapes in balls.items():
            around = np.concatenate(shapes)
            fitted = [fit_capsule(around)] if number else cover(around)
            turning = fit_capsule(around, on_axis=True) if number == 1 else None
            if turning is not None and turning.volume_ratio <= max(POOR, fitted[0].volume_ratio):
                fitted, at = [turning], part.mount
                base.append(_capsule(0, at.act(turning.start), at.act(turning.end), turning.radius, link))
            else:
                name = _name(link, part, number)
                found += [_capsule(number, fit.start, fit.end, fit.radius, name) for fit in fitted]
            fits[link] = max(fitted, key=lambda fit: fit.volume_ratio)
        if not balls and not options.capsules.keys() & part.places.keys():
            bare.append(part.link)
    if not moving:
        raise SettingsError(
            f"{file}: no moving link has collision geometry; expected some in the URDF, or some under capsules"
        )
    return LinkCapsules(tuple(base), tuple(moving), fits, bare)


def _name(link: str, part: Part, number: int) -> str:
    """Name of a capsule on a link that is fixed to the base; empty for the base's own and those of moving links."""
    return "" if number or link == part.link else link


def _link_balls(element: Element, file: Path, options: ArmOptions, place: pin.SE3, name: str) -> Array:
    """Balls (N, 4) whose convex hulls cover the collision shapes of a link at `place`."""
    found, where = [np.zeros((0, 4))], f"{file}: link '{name}'"
    for collision in element.findall("collision"):
        at = place * placement(collision.find("origin"))
        for shape in collision.findall("geometry/*"):
            balls = _mesh_balls(shape, file, options, where) if shape.tag == "mesh" else _balls(shape, where)
            found.append(np.column_stack([balls[:, :3] @ at.rotation.T + at.translation, balls[:, 3]]))
    return np.concatenate(found)


def _balls(shape: Element, where: str) -> Array:
    """Centres and radii (N, 4), m, of balls whose convex hull covers a box, cylinder, sphere or capsule."""
    if shape.tag == POINTS:
        return _points(vector_in(shape, "at").reshape(-1, 3))
    if shape.tag not in _SIZES:
        raise SettingsError(
            f"{where}: collision: geometry <{shape.tag}> is unknown; expected box, cylinder, sphere, capsule or mesh"
        )
    for key in _SIZES[shape.tag]:
        if key not in shape.attrib:
            raise SettingsError(f"{where}: collision: {shape.tag} has no {key}; expected one, m")
    if shape.tag == "box":
        corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
        return _points(corners * vector_in(shape, "size"))
    radius, length = (float(shape.get(key, "0")) for key in ("radius", "length"))
    if shape.tag == "sphere":
        return np.array([[0.0, 0.0, 0.0, radius]])
    ends = np.array([[0.0, 0.0, -0.5 * length, radius], [0.0, 0.0, 0.5 * length, radius]])
    if shape.tag == "capsule":
        return ends
    angles = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1) * radius
    return _points(np.concatenate([rim + end[:3] for end in ends]))


def _mesh_balls(shape: Element, urdf: Path, options: ArmOptions, where: str) -> Array:
    """The outer vertices of a mesh as balls (N, 4) without a radius, m."""
    name = shape.get("filename", "")
    path = find_mesh(name, urdf, options.packages)
    mend = "give the folder of its package under packages, or the link's capsules under capsules ([] for none)"
    if path is None:
        raise SettingsError(f"{where}: mesh '{name}' is not found; {mend}")
    try:
        scale = _unit(path) * vector_in(shape, "scale", "1 1 1")
        vertices = np.array(coal.MeshLoader(coal.NODE_TYPE.BV_AABB).load(str(path), scale).vertices())
        outer = vertices[ConvexHull(vertices).vertices]
    except QhullError:
        # A flat one: all of it is outside.
        outer = vertices
    except (ValueError, RuntimeError, ElementTree.ParseError) as error:
        raise SettingsError(f"{where}: mesh '{path}' cannot be read; expected a file with triangles; {mend}") from error
    return _points(np.unique(outer, axis=0))


def _unit(mesh: Path) -> float:
    """Metres in a unit of a mesh, which COLLADA files give and coal leaves aside."""
    unit = ElementTree.parse(mesh).find("{*}asset/{*}unit") if mesh.suffix.lower() == ".dae" else None
    return 1.0 if unit is None else float(unit.get("meter", "1"))


def _points(points: Array) -> Array:
    """Points (N, 3) as balls (N, 4)."""
    return np.column_stack([points, np.zeros(len(points))])


def _capsule(link: int, start: Array, end: Array, radius: float, name: str) -> Capsule:
    """In tenths of a millimetre; what fits stays inside."""
    begins, ends = (vector(np.round(point, 4) + 0.0) for point in (start, end))
    return Capsule(link, begins, ends, round(math.ceil(1e4 * radius) / 1e4 + 1e-4, 4), name)
