"""A URDF as a tree of links and joints, checked here because Pinocchio's parser names neither file nor link."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Array
from contact_reach_ros.errors import SettingsError

TURNING = ("revolute", "continuous")
"""Types of joints that an arm can have."""
_KINDS = (*TURNING, "prismatic", "fixed", "floating", "planar")
RANGE = ("lower", "upper")
LIMITS = (*RANGE, "velocity", "effort")
TENSOR = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_SIZES = ("radius", "length", "size", "armature")
_SHORT = 1e-9
"""Length of an axis that is a rounding error."""
_MOST = 1e9
"""Of all numbers but limits: no arm has larger ones, in units of the SI."""
_COUNTS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3}
"""Attributes with several numbers."""
_SOFT = ("soft_lower_limit", "soft_upper_limit")
_MIMIC = {"multiplier": 1.0, "offset": 0.0}
_NUMBERS = {*_COUNTS, *LIMITS, *TENSOR, *_SIZES, *_SOFT, *_MIMIC}
_READ = ("inertial", "collision", "origin", "axis", "limit", "safety_controller", "mimic", "dynamics")
"""Elements of links and joints that an arm is made of."""
ENDLESS = {"lower": 1e3, "upper": 1e3, "velocity": 1e3, "effort": 1e5}
"""Limits from here on, rad, rad/s, N m, stand for none: exporters write 1e16."""
_TURN = round(2.0 * math.pi, 4)


class UrdfJoint(NamedTuple):
    """A joint of a URDF."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def axis(self) -> Array:
        """Unit vector (3,) in the frame of the child."""
        axis = vector_in(self.element.find("axis"), "xyz", "1 0 0")
        return axis / float(np.linalg.norm(axis))

    def limits(self) -> tuple[dict[str, float], str]:
        """Limits in the file by `LIMITS`, rad, rad/s, N m, without those that stand for unknown ones, and a remark.

        Unknown are an empty range, and a speed or effort of zero or without end. An endless range is one turn to either
        side, and a safety controller makes it narrower, as far as some is left; the remark says so.
        """
        found, remark = numbers_in(self.element, "limit", LIMITS), ""
        if self.kind == "continuous":
            found |= {"lower": -math.inf, "upper": math.inf}
        hard = found.get("lower", 0.0), found.get("upper", 0.0)
        if hard[0] == hard[1]:
            found = {key: value for key, value in found.items() if key not in RANGE}
        soft = numbers_in(self.element, "safety_controller", _SOFT)
        low, high = max(hard[0], soft.get(_SOFT[0], hard[0])), min(hard[1], soft.get(_SOFT[1], hard[1]))
        if low < high and (low, high) != hard:
            found |= {"lower": low, "upper": high}
            remark = f" from {low:g} to {high:g} rad, its soft ones"
        for key in RANGE:
            if abs(found.get(key, 0.0)) >= ENDLESS[key]:
                found[key] = math.copysign(_TURN, found[key])
                remark = ", which is continuous, turns once to either side"
        return {key: value for key, value in found.items() if key in RANGE or (value and value < ENDLESS[key])}, remark

    def mimicked(self) -> tuple[str, float, float] | None:
        """The joint that this one follows, with factor and offset, rad or m; None if it moves on its own."""
        mimic = self.element.find("mimic")
        if mimic is None:
            return None
        factors = _MIMIC | numbers_in(self.element, "mimic", _MIMIC)
        return mimic.get("joint", ""), factors["multiplier"], factors["offset"]


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints by name."""

    name: str
    gravity: Array
    """(3,), m/s², in the frame of the root."""
    links: Mapping[str, Element]
    joints: Mapping[str, UrdfJoint]
    above: Mapping[str, UrdfJoint]
    """The joint that moves each link but the root, by the link's name."""

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        return next(name for name in self.links if name not in self.above)

    def below(self, link: str) -> list[UrdfJoint]:
        """The joints that begin at a link, in the order of the links that they move."""
        return [self.above[child] for child in sorted(self.above) if self.above[child].parent == link]

    def chain(self, base: str, tip: str) -> list[UrdfJoint] | None:
        """The joints from one link to another, or None if the other is not below."""
        joints: list[UrdfJoint] = []
        while tip != base:
            if tip not in self.above:
                return None
            joints.insert(0, self.above[tip])
            tip = joints[0].parent
        return joints


def numbers_in(element: Element, tag: str, keys: Iterable[str]) -> dict[str, float]:
    """Numbers in the attributes of the first such element in another, as far as they are there."""
    found = element.find(tag)
    return {} if found is None else {key: float(found.attrib[key]) for key in keys if key in found.attrib}


def vector_in(element: Element | None, key: str, default: str = "") -> Array:
    """Numbers (N,) in an attribute of an element, if both are there."""
    return np.array((default if element is None else element.get(key, default)).split(), float)


def placement(origin: Element | None) -> pin.SE3:
    """Where an <origin> places something; at the frame itself without one."""
    return pin.SE3(pin.rpy.rpyToMatrix(vector_in(origin, "rpy", "0 0 0")), vector_in(origin, "xyz", "0 0 0"))


def tree_of(robot: Element, file: Path) -> UrdfTree:
    """The tree of a robot in a URDF.

    Raises `SettingsError`, naming `file`, and link or joint, if its links form no tree or have no names of their own.
    """
    links = _by_name(robot, "link", file)
    if not links:
        raise SettingsError(
            f"{file}: has no links; expected links and joints: if it is a xacro file that only defines macros, give "
            "one that calls them"
        )
    for name, element in links.items():
        check_numbers(element, f"{file}: link '{name}'")
    joints = {name: _joint(each, f"{file}: joint '{name}'") for name, each in _by_name(robot, "joint", file).items()}
    above: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        for end in (joint.parent, joint.child):
            if end not in links:
                raise SettingsError(f"{file}: joint '{joint.name}' joins link '{end}', which does not exist")
        if joint.child in above:
            raise SettingsError(
                f"{file}: closed loop: joints '{above[joint.child].name}' and '{joint.name}' both move link "
                f"'{joint.child}'; expected a tree, with one joint above each link"
            )
        mimicked = joint.mimicked()
        if mimicked and mimicked[0] not in joints:
            raise SettingsError(f"{file}: joint '{joint.name}' mimics joint '{mimicked[0]}', which does not exist")
        above[joint.child] = joint
    for joint in joints.values():
        followed = [joint.name]
        while (mimicked := joints[followed[-1]].mimicked()) is not None:
            if mimicked[0] in followed:
                raise SettingsError(f"{file}: joint '{joint.name}' mimics itself; expected one that moves on its own")
            followed.append(mimicked[0])
    roots = [name for name in links if name not in above]
    if len(roots) != 1:
        found = ", ".join(f"'{name}'" for name in roots) or "none: the joints form a closed loop"
        raise SettingsError(f"{file}: links that no joint moves: {found}; expected one, the root of a tree")
    # URDFs have none; it comes from an MJCF.
    return UrdfTree(robot.get("name", file.stem), vector_in(robot, "gravity", "0 0 -9.81"), links, joints, above)


def _by_name(robot: Element, tag: str, file: Path) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in robot.findall(tag):
        name = element.get("name", "")
        if not name or name in found:
            wrong = f"{tag} '{name}' is there twice" if name else f"a {tag} has no name"
            raise SettingsError(f"{file}: {wrong}; expected a name of its own for each {tag}: rename or remove one")
        found[name] = element
    return found


def _joint(element: Element, where: str) -> UrdfJoint:
    check_numbers(element, where)
    ends = [end.get("link", "") for tag in ("parent", "child") if (end := element.find(tag)) is not None]
    if len(ends) != 2:
        raise SettingsError(f"{where}: expected <parent link=...> and <child link=...>")
    axis, kind = vector_in(element.find("axis"), "xyz", "1 0 0"), element.get("type", "")
    if kind not in _KINDS:
        raise SettingsError(f"{where}: type = '{kind}'; expected one of {', '.join(_KINDS)}")
    if kind != "fixed" and not np.linalg.norm(axis) > _SHORT:
        raise SettingsError(f"{where}: axis = {axis.tolist()}; expected a vector that is not zero")
    return UrdfJoint(element.get("name", ""), kind, ends[0], ends[1], element)


def check_numbers(element: Element, where: str) -> None:
    """Refuse a link or joint with an attribute whose numbers are too few, not finite, or negative sizes.

    Raises `SettingsError`; the message begins with `where`.
    """
    for part in (each for tag in _READ for found in element.findall(tag) for each in found.iter()):
        is_mass = part.tag == "mass"
        if is_mass and "value" not in part.attrib:
            raise SettingsError(f"{where}: mass has no value; expected <mass value=.../>, kg")
        # Other elements may have words as their value.
        for key in (key for key in part.attrib if key in _NUMBERS or (is_mass and key == "value")):
            try:
                values = [] if "_" in part.get(key, "") else [float(word) for word in part.get(key, "").split()]
            except ValueError:
                values = []
            count = _COUNTS.get(key, 1)
            # Limits may have no end.
            least, most = 0.0 if key in _SIZES else -math.inf, math.inf if key in LIMITS else _MOST
            expected = f"{count} finite number{'s' * (count > 1)}" + " of at least 0" * (key in _SIZES)
            if len(values) != count or not all(least <= value and abs(value) <= most for value in values):
                raise SettingsError(f"{where}: {part.tag} {key} = '{part.get(key)}'; expected {expected}")
