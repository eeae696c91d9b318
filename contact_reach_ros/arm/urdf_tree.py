"""A URDF file as a tree of links and joints, checked here because Pinocchio's parser names neither file nor link."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from contact_reach_ros.errors import SettingsError

TURNING = ("revolute", "continuous")
"""Types of joints that an arm can have."""
LIMITS = ("lower", "upper", "velocity", "effort")
TENSOR = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_SIZES = ("radius", "length", "size")
_COUNTS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3}
"""Attributes with several numbers."""
_NUMBERS = {*_COUNTS, *LIMITS, *TENSOR, *_SIZES, "value"}
_READ = ("inertial", "collision", "origin", "axis", "limit")
"""Elements of links and joints that an arm is made of."""


class UrdfJoint(NamedTuple):
    """A joint of a URDF."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    def limits(self) -> dict[str, float]:
        """Limits in the file by `LIMITS`, rad, rad/s, N m; zero range, speed or effort stand for unknown ones."""
        limit = self.element.find("limit")
        found = {} if limit is None else {key: float(limit.get(key, "")) for key in LIMITS if key in limit.attrib}
        if found.get("lower", 0.0) == found.get("upper", 0.0) or self.kind == "continuous":
            found = {key: value for key, value in found.items() if key not in ("lower", "upper")}
        return {key: value for key, value in found.items() if key in ("lower", "upper") or value > 0.0}


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints by name."""

    name: str
    links: Mapping[str, Element]
    joints: Mapping[str, UrdfJoint]
    above: Mapping[str, UrdfJoint]
    """The joint that moves each link but the root, by the link's name."""

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        return next(name for name in self.links if name not in self.above)

    def below(self, link: str) -> list[UrdfJoint]:
        """The joints that begin at a link."""
        return [joint for joint in self.above.values() if joint.parent == link]

    def chain(self, base: str, tip: str) -> list[UrdfJoint] | None:
        """The joints from one link to another, or None if the other is not below."""
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
    links = {element.get("name", ""): element for element in robot.findall("link")}
    for name, element in links.items():
        _check_numbers(element, f"{file}: link '{name}'")
    joints = [_joint(element, f"{file}: joint '{element.get('name')}'") for element in robot.findall("joint")]
    above: dict[str, UrdfJoint] = {}
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in links:
                raise SettingsError(f"{file}: joint '{joint.name}' joins link '{end}', which does not exist")
        if joint.child in above:
            raise SettingsError(
                f"{file}: closed loop: joints '{above[joint.child].name}' and '{joint.name}' both move link "
                f"'{joint.child}'; expected a tree, with one joint above each link"
            )
        above[joint.child] = joint
    roots = [name for name in links if name not in above]
    if len(roots) != 1:
        found = ", ".join(f"'{name}'" for name in roots) or "none: the joints form a closed loop"
        raise SettingsError(f"{file}: links that no joint moves: {found}; expected one, the root of a tree")
    return UrdfTree(robot.get("name", file.stem), links, {joint.name: joint for joint in joints}, above)


def _joint(element: Element, where: str) -> UrdfJoint:
    _check_numbers(element, where)
    ends = [end.get("link", "") for tag in ("parent", "child") if (end := element.find(tag)) is not None]
    if len(ends) != 2:
        raise SettingsError(f"{where}: expected <parent link=...> and <child link=...>")
    axis = element.find("axis")
    if axis is not None and not any(map(float, axis.get("xyz", "1 0 0").split())):
        raise SettingsError(f"{where}: axis = '{axis.get('xyz')}'; expected a vector that is not zero")
    return UrdfJoint(element.get("name", ""), element.get("type", ""), ends[0], ends[1], element)


def _check_numbers(element: Element, where: str) -> None:
    """Refuse a link or joint with an attribute whose numbers are too few, not finite, or negative sizes."""
    for part in (each for tag in _READ for found in element.findall(tag) for each in found.iter()):
        for key in filter(_NUMBERS.__contains__, part.attrib):
            try:
                values = [float(word) for word in part.get(key, "").split()]
            except ValueError:
                values = []
            count = _COUNTS.get(key, 1)
            expected = f"{count} finite number{'s' * (count > 1)}" + " of at least 0" * (key in _SIZES)
            if len(values) != count or not np.isfinite(values).all() or (key in _SIZES and min(values) < 0.0):
                raise SettingsError(f"{where}: {part.tag} {key} = '{part.get(key)}'; expected {expected}")
