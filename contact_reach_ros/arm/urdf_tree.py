"""A URDF as a tree of links and joints, checked here because Pinocchio's parser names neither file nor link."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from contact_reach_ros.errors import SettingsError

TURNING = ("revolute", "continuous")
"""Types of joints that an arm can have."""
_RANGE = ("lower", "upper")
LIMITS = (*_RANGE, "velocity", "effort")
TENSOR = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_SIZES = ("radius", "length", "size")
_COUNTS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3}
"""Attributes with several numbers."""
_SOFT = {"lower": "soft_lower_limit", "upper": "soft_upper_limit"}
_MIMIC = {"multiplier": 1.0, "offset": 0.0}
_NUMBERS = {*_COUNTS, *LIMITS, *TENSOR, *_SIZES, *_SOFT.values(), *_MIMIC, "value"}
_READ = ("inertial", "collision", "origin", "axis", "limit", "safety_controller", "mimic")
"""Elements of links and joints that an arm is made of."""
_ENDLESS = {"lower": 1e3, "upper": 1e3, "velocity": 1e3, "effort": 1e5}
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
    def is_endless(self) -> bool:
        """Whether the joint is continuous, or its range is endless to one side."""
        found = numbers_in(self.element, "limit", LIMITS)
        return self.kind == "continuous" or any(abs(found.get(key, 0.0)) >= _ENDLESS[key] for key in _RANGE)

    @property
    def soft_limits(self) -> dict[str, float]:
        """Ends of the range, rad or m, that a safety controller makes narrower, as far as some range is left."""
        found = numbers_in(self.element, "limit", LIMITS)
        lower, upper = (found.get(key, 0.0) for key in _RANGE)
        soft = numbers_in(self.element, "safety_controller", _SOFT.values())
        low, high = max(lower, soft.get(_SOFT["lower"], lower)), min(upper, soft.get(_SOFT["upper"], upper))
        if self.kind == "continuous" or not low < high:
            return {}
        return {key: new for key, new, old in (("lower", low, lower), ("upper", high, upper)) if new != old}

    def limits(self) -> dict[str, float]:
        """Limits in the file by `LIMITS`, rad, rad/s, N m, without those that stand for unknown ones.

        These are an empty range, and a speed or effort of zero or without end. An endless range is one turn to either
        side, and soft limits count.
        """
        found = numbers_in(self.element, "limit", LIMITS)
        if self.kind == "continuous":
            found |= {"lower": -math.inf, "upper": math.inf}
        if found.get("lower", 0.0) == found.get("upper", 0.0):
            found = {key: value for key, value in found.items() if key not in _RANGE}
        found |= self.soft_limits
        for key in _RANGE:
            if abs(found.get(key, 0.0)) >= _ENDLESS[key]:
                found[key] = math.copysign(_TURN, found[key])
        return {key: value for key, value in found.items() if key in _RANGE or 0.0 < value < _ENDLESS[key]}

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


def numbers_in(element: Element, tag: str, keys: Iterable[str]) -> dict[str, float]:
    """Numbers in the attributes of the first such element in another, as far as they are there."""
    found = element.find(tag)
    return {} if found is None else {key: float(found.attrib[key]) for key in keys if key in found.attrib}


def tree_of(robot: Element, file: Path) -> UrdfTree:
    """The tree of a robot in a URDF.

    Raises
    ------
    SettingsError
        If its links do not form a tree, or have no names of their own; the message names `file`, and link or joint.
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
    return UrdfTree(robot.get("name", file.stem), links, joints, above)


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
    axis, kind = element.find("axis"), element.get("type", "")
    if axis is not None and kind != "fixed" and not any(map(float, axis.get("xyz", "1 0 0").split())):
        raise SettingsError(f"{where}: axis = '{axis.get('xyz')}'; expected a vector that is not zero")
    return UrdfJoint(element.get("name", ""), kind, ends[0], ends[1], element)


def check_numbers(element: Element, where: str) -> None:
    """Refuse a link or joint with an attribute whose numbers are too few, not finite, or negative sizes.

    Raises `SettingsError`; the message begins with `where`.
    """
    for part in (each for tag in _READ for found in element.findall(tag) for each in found.iter()):
        for key in filter(_NUMBERS.__contains__, part.attrib):
            try:
                values = [float(word) for word in part.get(key, "").split()]
            except ValueError:
                values = []
            count = _COUNTS.get(key, 1)
            # Limits may have no end.
            least, most = 0.0 if key in _SIZES else -math.inf, math.inf if key in LIMITS else sys.float_info.max
            expected = f"{count} finite number{'s' * (count > 1)}" + " of at least 0" * (key in _SIZES)
            if len(values) != count or not all(least <= value and abs(value) <= most for value in values):
                raise SettingsError(f"{where}: {part.tag} {key} = '{part.get(key)}'; expected {expected}")
