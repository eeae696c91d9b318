"""A URDF file as a tree of links and joints: what it says, before anything is made of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import SettingsError

TURNING = ("revolute", "continuous")
"""Types of joints that an arm can have."""


@dataclass(frozen=True)
class Mass:
    """Inertial parameters of a link in its frame."""

    mass: float
    """kg."""
    center: Array
    """(3,), m."""
    tensor: Array
    """(3, 3) about the centre, kg m²."""


@dataclass(frozen=True)
class Shape:
    """One collision geometry of a link."""

    place: Array
    """(4, 4) in the link's frame."""
    kind: str
    """'box', 'cylinder', 'sphere', 'capsule' or 'mesh'."""
    size: tuple[float, ...]
    """Sides, or radius and length, m; of a mesh its scale."""
    file: str = ""
    """Of a mesh, as the URDF has it."""


@dataclass(frozen=True)
class UrdfLink:
    """One link."""

    name: str
    mass: Mass | None
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class UrdfJoint:
    """One joint; `limits` has those of lower, upper, velocity and effort that the file has."""

    name: str
    kind: str
    parent: str
    child: str
    place: Array
    """(4, 4) of the child's frame in the parent's at angle zero."""
    axis: Array
    """(3,) in the child's frame."""
    limits: dict[str, float]
    mimics: str
    """Name of the joint that it copies; empty for none."""


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints by name."""

    source: str
    """Path of the file, for messages."""
    name: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    above: dict[str, UrdfJoint] = field(repr=False)
    """The joint that moves each link but the root, by the link's name."""

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        return next(name for name in self.links if name not in self.above)

    def below(self, link: str) -> list[UrdfJoint]:
        """The joints that begin at a link."""
        return [joint for joint in self.joints.values() if joint.parent == link]

    def chain(self, base: str, tip: str) -> list[UrdfJoint] | None:
        """The joints from one link to another, or None if that one is not below."""
        joints: list[UrdfJoint] = []
        while tip != base:
            if tip not in self.above:
                return None
            joints.insert(0, self.above[tip])
            tip = joints[0].parent
        return joints


def read_urdf(file: Path) -> UrdfTree:
    """Read a URDF file.

    Raises
    ------
    SettingsError
        If it cannot be read, is no URDF, or its links do not form a tree; the message names file, and link or joint.
    """
    try:
        robot = ElementTree.parse(file).getroot()
    except OSError as error:
        raise SettingsError(f"{file}: cannot be read ({error.strerror}); give the path of a URDF file") from error
    except ElementTree.ParseError as error:
        raise SettingsError(f"{file}: not valid XML: {error}; a xacro file must be expanded first") from error
    if robot.tag != "robot":
        raise SettingsError(f"{file}: its root is <{robot.tag}>; expected <robot>")
    if any("xacro" in element.tag for element in robot.iter()):
        raise SettingsError(f"{file}: has xacro tags; expand it first: xacro {file.name} > arm.urdf")
    links = [_link(element, f"{file}: link '{element.get('name')}'") for element in robot.findall("link")]
    joints = [_joint(element, f"{file}: joint '{element.get('name')}'") for element in robot.findall("joint")]
    names = {link.name for link in links}
    above: dict[str, UrdfJoint] = {}
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in names:
                raise SettingsError(f"{file}: joint '{joint.name}' joins link '{end}', which does not exist")
        if joint.child in above:
            raise SettingsError(
                f"{file}: closed loop: joints '{above[joint.child].name}' and '{joint.name}' both move link "
                f"'{joint.child}'; expected a tree, with one joint above each link"
            )
        above[joint.child] = joint
    roots = [link.name for link in links if link.name not in above]
    if len(roots) != 1:
        found = ", ".join(f"'{name}'" for name in roots) or "none: the joints form a closed loop"
        raise SettingsError(f"{file}: links that no joint moves: {found}; expected one, the root of a tree")
    by_name = {joint.name: joint for joint in joints}
    return UrdfTree(str(file), robot.get("name", file.stem), {link.name: link for link in links}, by_name, above)


def placement(element: Element | None, where: str) -> Array:
    """The transform (4, 4) of an <origin>, which may be missing."""
    transform = np.eye(4)
    if element is not None:
        transform[:3, 3] = _numbers(element.get("xyz", "0 0 0"), 3, f"{where}: origin xyz")
        angles = _numbers(element.get("rpy", "0 0 0"), 3, f"{where}: origin rpy")
        transform[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    return transform


def _link(element: Element, where: str) -> UrdfLink:
    inertial = element.find("inertial")
    shapes = tuple(_shapes(element, where))
    return UrdfLink(element.get("name", ""), None if inertial is None else _mass(inertial, where), shapes)


def _mass(element: Element, where: str) -> Mass:
    place = placement(element.find("origin"), where)
    mass, inertia = element.find("mass"), element.find("inertia")
    value = 0.0 if mass is None else _number(mass.get("value", "0"), f"{where}: mass")
    tensor = np.zeros((3, 3))
    if inertia is not None:
        for row, first in enumerate("xyz"):
            for column, second in enumerate("xyz"[row:], row):
                key = f"i{first}{second}"
                tensor[row, column] = tensor[column, row] = _number(inertia.get(key, "0"), f"{where}: {key}")
    return Mass(value, place[:3, 3], place[:3, :3] @ tensor @ place[:3, :3].T)


def _shapes(link: Element, where: str) -> Iterator[Shape]:
    for element in link.findall("collision"):
        where_it_is = f"{where}: collision"
        place = placement(element.find("origin"), where_it_is)
        for shape in element.findall("geometry/*"):
            if shape.tag == "mesh":
                scale = _numbers(shape.get("scale", "1 1 1"), 3, f"{where_it_is}: scale")
                yield Shape(place, "mesh", scale, shape.get("filename", ""))
            elif shape.tag == "box":
                yield Shape(place, "box", _sizes(shape.get("size", ""), 3, f"{where_it_is}: size"))
            elif shape.tag in ("cylinder", "capsule"):
                text = f"{shape.get('radius', '')} {shape.get('length', '')}"
                yield Shape(place, shape.tag, _sizes(text, 2, f"{where_it_is}: radius and length"))
            elif shape.tag == "sphere":
                yield Shape(place, "sphere", _sizes(shape.get("radius", ""), 1, f"{where_it_is}: radius"))
            else:
                raise SettingsError(
                    f"{where_it_is}: geometry <{shape.tag}> is unknown; expected box, cylinder, sphere, capsule or mesh"
                )


def _joint(element: Element, where: str) -> UrdfJoint:
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise SettingsError(f"{where}: expected <parent link=...> and <child link=...>")
    axis_element, limit, mimic = element.find("axis"), element.find("limit"), element.find("mimic")
    kind = element.get("type", "")
    axis = np.array([1.0, 0.0, 0.0])
    if axis_element is not None and kind != "fixed":
        axis = np.array(_numbers(axis_element.get("xyz", "1 0 0"), 3, f"{where}: axis"))
        length = float(np.linalg.norm(axis))
        if length < 1e-9:
            raise SettingsError(f"{where}: axis = {axis.tolist()}; expected a vector that is not zero")
        axis /= length
    keys = () if limit is None else ("lower", "upper", "velocity", "effort")
    limits = {
        key: _number(limit.get(key, ""), f"{where}: {key}") for key in keys if limit is not None and key in limit.attrib
    }
    # A limit of zero range, speed or effort stands for one that is not known.
    if limits.get("lower", 0.0) == limits.get("upper", 0.0) or kind == "continuous":
        limits = {key: limits[key] for key in limits if key not in ("lower", "upper")}
    limits = {key: value for key, value in limits.items() if key in ("lower", "upper") or value > 0.0}
    return UrdfJoint(
        element.get("name", ""),
        kind,
        parent.get("link", ""),
        child.get("link", ""),
        placement(element.find("origin"), where),
        axis,
        limits,
        "" if mimic is None else mimic.get("joint", ""),
    )


def _number(text: str, where: str) -> float:
    return _numbers(text, 1, where)[0]


def _numbers(text: str, count: int, where: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise SettingsError(f"{where} = '{text}'; expected {count} finite number{'s' if count > 1 else ''}")
    return values


def _sizes(text: str, count: int, where: str) -> tuple[float, ...]:
    values = _numbers(text, count, where)
    if min(values) < 0.0:
        raise SettingsError(f"{where} = '{text}'; expected sizes of at least 0 m")
    return values
