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

from contact_reach_ros.arm.arm import Array, Capsule
from contact_reach_ros.arm.capsule_fit import POOR, Fit, cover, fit_capsule
from contact_reach_ros.arm.kinematics import vector
from contact_reach_ros.arm.robot_file import POINTS
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.arm.urdf_tree import placement, vector_in
from contact_reach_ros.errors import SettingsError

_RIM = 128
"""Points on the rim of a cylinder, of which they leave 0.03 % of the radius outside."""
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
"""Attributes of shapes."""
_FACES = ("triangles", "polylist", "polygons", "trifans", "tristrips")
_MOVES = ("matrix", "translate", "rotate", "scale", "lookat", "skew")
"""Elements of COLLADA files."""
_MEND = "give the folder of its package under packages, or the link's capsules under capsules ([] for none)"


class Part(NamedTuple):
    """A moving link, or the base, with all links that are fixed to it."""

    link: str
    mount: pin.SE3
    """Its frame, turned so that the joint turns about z, in that of the part before; the base's is not turned."""
    places: dict[str, pin.SE3]
    """Frames of the link and of those that are fixed to it, in the turned frame."""


def link_capsules(
    links: Mapping[str, Element],
    meshes: Mapping[str, Path],
    file: Path,
    options: ArmOptions,
    parts: Sequence[Part],
    assumed: list[str],
) -> tuple[tuple[Capsule, ...], tuple[Capsule, ...], dict[str, Fit]]:
    """Find the capsules of the base and the moving links; returns both, and those that were fitted, by link.

    Each fixed link has a capsule around its collision geometry, or several around a table or a platform, and each
    moving link one around its own and that of the links that are fixed to it; links with given capsules have these
    instead. The first link's belongs to the base if one around the joint's axis, which does not move, is no poor fit.
    Of several fits for a link the worst is returned.

    Raises `SettingsError` if meshes are missing, all at once, or one cannot be read, or no moving link has collision
    geometry or given capsules.

    Parameters
    ----------
    links, meshes, file, options
        Links of the URDF by name, files of the meshes that were found by the names that it has for them, its path, and
        what it leaves open.
    parts
        The base, then the moving links.
    assumed
        Gets a line for each moving link without collision geometry, and the base if nothing that is fixed to it has
        any, and for links whose geometry is a mere point, such as a box of size 0.
    """
    base: list[Capsule] = []
    moving: list[Capsule] = []
    fits: dict[str, Fit] = {}
    bare, without_size = [], []
    lost: dict[str, str] = {}
    for element in (links[name] for part in parts for name in part.places if name not in options.capsules):
        for mesh in element.iterfind("collision/geometry/mesh"):
            if (name := mesh.get("filename", "")) not in meshes:
                lost.setdefault(name, f"link '{element.get('name')}': mesh '{name}'")
    if lost:
        raise SettingsError(f"{file}: {'; '.join(lost.values())}: not found; {_MEND}")
    for number, part in enumerate(parts):
        found = moving if number else base
        # By the link whose capsule is around them.
        balls: dict[str, list[Array]] = {}
        for link, place in part.places.items():
            if link in options.capsules:
                for given in options.capsules[link]:
                    start, end = (vector(place.act(np.array(point))) for point in (given.start, given.end))
                    found.append(Capsule(number, start, end, given.radius, _name(link, part, number)))
                continue
            shapes = _link_shapes(links[link], f"{file}: link '{link}'", meshes, place)
            sized = [each for each in shapes if each[:, 3].any() or np.ptp(each, axis=0).any()]
            without_size += [link] * (len(sized) < len(shapes))
            if sized:
                balls.setdefault(part.link if number else link, []).extend(sized)
        for link, found_balls in balls.items():
            around = np.concatenate(found_balls)
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
    assumed += [f"capsules: none on {link}, which has no collision geometry" for link in bare]
    assumed += [f"capsules: collision geometry of {link} has no size" for link in without_size]
    return tuple(base), tuple(moving), fits


def _name(link: str, part: Part, number: int) -> str:
    """Name of a capsule on a link that is fixed to the base; empty for the base's own and those of moving links."""
    return "" if number or link == part.link else link


def _link_shapes(element: Element, where: str, meshes: Mapping[str, Path], place: pin.SE3) -> list[Array]:
    """For each collision shape of a link at `place`, balls (N, 4) whose convex hull covers it."""
    found = []
    for collision in element.findall("collision"):
        at = place * placement(collision.find("origin"))
        for shape in collision.findall("geometry/*"):
            balls = (
                _mesh_balls(shape, where, meshes[shape.get("filename", "")])
                if shape.tag == "mesh"
                else _balls(shape, where)
            )
            found.append(np.column_stack([balls[:, :3] @ at.rotation.T + at.translation, balls[:, 3]]))
    return found


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


def _mesh_balls(shape: Element, where: str, path: Path) -> Array:
    """The outer vertices of a mesh as balls (N, 4) without a radius, m."""
    try:
        collada = ElementTree.parse(path).getroot() if path.suffix.lower() == ".dae" else None
        unit = None if collada is None else collada.find("{*}asset/{*}unit")
        # Metres in a unit of the file, which coal leaves aside.
        metres = 1.0 if unit is None else float(unit.get("meter", "1"))
        scale: Array = metres * vector_in(shape, "scale", "1 1 1")
        vertices = np.zeros((0, 3)) if collada is None else scale * _bare_points(collada)
        if not len(vertices):
            vertices = np.array(coal.MeshLoader(coal.NODE_TYPE.BV_AABB).load(str(path), scale).vertices())
        outer = vertices[ConvexHull(vertices).vertices]
    except QhullError:
        # A flat one: all of it is outside.
        outer = vertices
    except (ValueError, RuntimeError, ElementTree.ParseError) as error:
        expected = "expected a file with triangles"
        raise SettingsError(f"{where}: mesh '{path}' cannot be read; {expected}; {_MEND}") from error
    return _points(np.unique(outer, axis=0))


def _bare_points(collada: Element) -> Array:
    """Points (V, 3) of a COLLADA file without faces, of which coal would make something else; none if it has faces.

    Raises `ValueError` if the file moves them.
    """
    if any(collada.find(f".//{{*}}{tag}") is not None for tag in _FACES):
        return np.zeros((0, 3))
    if any(collada.find(f".//{{*}}{tag}") is not None for tag in _MOVES):
        raise ValueError("points that are moved")
    named = {each.get("source", "")[1:] for each in collada.iterfind(".//{*}vertices/{*}input[@semantic='POSITION']")}
    sources = [each for each in collada.iterfind(".//{*}mesh/{*}source") if each.get("id") in named]
    numbers = [each.findtext("{*}float_array", "").split() for each in sources]
    return np.array([number for each in numbers for number in each], float).reshape(-1, 3)


def _points(points: Array) -> Array:
    """Points (N, 3) as balls (N, 4)."""
    return np.column_stack([points, np.zeros(len(points))])


def _capsule(link: int, start: Array, end: Array, radius: float, name: str) -> Capsule:
    """In tenths of a millimetre; what fits stays inside."""
    begins, ends = (vector(np.round(point, 4) + 0.0) for point in (start, end))
    return Capsule(link, begins, ends, round(math.ceil(round(1e4 * radius, 3)) / 1e4 + 1e-4, 4), name)
