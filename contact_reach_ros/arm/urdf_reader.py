"""Arms in files: a URDF, xacro or MJCF file with the few choices that it leaves open, or a table.

Pinocchio reads frames and inertias, and lumps what is fixed.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import assumptions
from contact_reach_ros.arm.arm import Arm, Inertia, Joint
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import Fit, frame_about
from contact_reach_ros.arm.kinematics import tensor_matrix, tensor_values
from contact_reach_ros.arm.link_capsules import Part, link_capsules, placement, vector
from contact_reach_ros.arm.mjcf import numbers
from contact_reach_ros.arm.mount import gravity_of, in_words
from contact_reach_ros.arm.plausibility import LEAST_EFFORT, Faults, check_inertia, check_weight, doubts
from contact_reach_ros.arm.robot_file import DESCRIPTIONS, read_robot_file
from contact_reach_ros.arm.table import ARMATURE, ArmOptions, arm_of_table, check_lengths, converted, gravity_in
from contact_reach_ros.arm.urdf_tree import (
    LIMITS,
    TENSOR,
    TURNING,
    UrdfJoint,
    UrdfTree,
    check_numbers,
    numbers_in,
    tree_of,
)
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import read_yaml

MAX_JOINTS = 7
_YAML = (".yaml", ".yml")
_OF_TABLES = "joints"
"""Key that only a table has."""
_TIP = re.compile(r"(^|.*[_/])(tool0|tool_frame|tcp|attachment_site)$", re.IGNORECASE)
"""Names of frames that are made for tips."""
_GRIPPER = re.compile(r"jaw|finger|claw|knuckle|thumb", re.IGNORECASE)
"""In names of joints and of the links that they move, and gripper in those of joints: what grips is no part of the
arm."""
_ROUNDING = 1e-10
_DIGITS = 12
"""Decimals of joints' places, m."""
_LINK = "link "
"""Prefix of links for Pinocchio, which finds frames by name: neither joints nor its universe have such a name."""


class Reading(NamedTuple):
    """An arm, and how it came about."""

    arm: Arm
    fits: dict[str, Fit]
    """The capsules that were fitted, by link."""
    assumed: list[str]
    """What neither the file nor the options say, in words."""
    doubts: list[str]
    """What is accepted although it is hardly that of a real arm, in words."""


def read_arm(file: Path, options: ArmOptions | None = None, options_file: Path | None = None) -> Reading:
    """Make an arm of a URDF, xacro or MJCF file; `options_file` is where errors say that options belong.

    Each link's frame is the URDF's, turned so that the joint turns about its z axis; links joined by fixed joints are
    one link.

    Raises
    ------
    SettingsError
        If the file is not that of a serial arm with revolute joints, or lacks something; the message names all links
        or joints, what was expected, and the key of `ArmOptions` that mends it.
    """
    options = options or ArmOptions()
    found = read_robot_file(file, options)
    return _Reader(tree_of(found.robot, file), file, options, found.assumed, options_file).read()


class _Reader:
    def __init__(
        self, tree: UrdfTree, file: Path, options: ArmOptions, assumed: Sequence[str], options_file: Path | None
    ) -> None:
        self.tree, self.file, self.options = tree, file, options
        self.assumed = list(assumed)
        self.faults = Faults(file, options_file or file.with_name(f"{_stem(file)}.yaml"))
        for key in ("fixed", "limits"):
            self._check_names(key, getattr(options, key), tree.joints, "joint")
        for key in ("inertias", "capsules"):
            self._check_names(key, getattr(options, key), tree.links, "link")

    def read(self) -> Reading:
        options, tree = self.options, self.tree
        base = options.base or tree.root
        tip = options.tip or self._only_tip(base)
        for key, link in (("base", base), ("tip", tip)):
            if link not in tree.links:
                raise SettingsError(
                    f"{self.file}: {key} = '{link}' is no link; expected one of {', '.join(tree.links)}"
                )
        moving = self._moving(base, tip)
        given = options.armature
        armature = given if isinstance(given, tuple) else tuple(_armature(joint, given) for joint in moving)
        lists: dict[str, Sequence[float]] = {f"thresholds: {key}": list_ for key, list_ in options.thresholds.items()}
        lists |= {"armature": armature} | ({} if options.home is None else {"home": options.home})
        check_lengths(lists, len(moving), str(self.file))
        model = self._model(moving)
        parts = _parts(model, base, moving)
        joints, inertias = [], []
        for number, (joint, own_armature) in enumerate(zip(moving, armature, strict=True), 1):
            place = parts[number - 1].turn.actInv(model.jointPlacements[number]) * parts[number].turn
            joints.append(self._joint(joint, place, own_armature))
            inertias.append(_inertia(parts[number], model.inertias[number]))
            own = {name: each for name in parts[number].places if (each := self._own_inertia(name)) is not None}
            check_inertia(self.faults, parts[number].link, model.inertias[number], own)
        self.faults.check()
        tip_place = parts[-1].places[tip]
        self._show_visuals(parts)
        found = link_capsules(tree.links, self.file, options, parts, joints[0])
        self.assumed += [f"capsules: none on {link}, which has no collision geometry" for link in found.bare]
        arm = Arm(
            name=options.name or tree.name,
            joints=tuple(joints),
            link_names=tuple(part.link for part in parts[1:]),
            base_frame=base,
            tip_frame=tip if tip != parts[-1].link else f"{tip}_tip",
            tip_offset=vector(tip_place.translation),
            tip_rotation=_quaternion(tip_place.rotation),
            capsules=found.links,
            base_capsules=found.base,
            inertia_sets={"nominal": tuple(inertias)},
            shoulder=(0.0, 0.0, 0.0),
            reach=0.0,
            home=tuple(0.5 * (joint.lower + joint.upper) for joint in joints),
            defaults={},
            gravity=gravity_in(options, str(self.file)) or gravity_of(parts[0].turn.rotation),
        )
        if options.mount is None:
            self.assumed.append(f"mount: {tree.root} stands upright: {in_words(arm)}")
        arm = self._completed(arm)
        check_weight(self.faults, arm)
        self.faults.check()
        return Reading(arm, found.fits, self.assumed, doubts(arm))

    def _completed(self, arm: Arm) -> Arm:
        """The arm with shoulder, reach, home and thresholds."""
        options = self.options
        arm = dataclasses.replace(arm, shoulder=assumptions.shoulder(arm))
        if options.reach is None:
            self.assumed.append("reach: 90 % of the greatest distance of the tip from the shoulder")
        arm = dataclasses.replace(arm, reach=assumptions.reach(arm) if options.reach is None else options.reach)
        if options.home is None:
            self.assumed.append("home: a posture in front of the arm, far from singularities")
        home = assumptions.home(arm) if options.home is None else options.home
        for joint, angle in zip(arm.joints, home, strict=True):
            if not joint.lower <= angle <= joint.upper:
                raise SettingsError(
                    f"{self.file}: home has {angle:g} rad for joint '{joint.name}'; expected an angle in "
                    f"[{joint.lower:g}, {joint.upper:g}] rad"
                )
        if not options.thresholds:
            self.assumed.append("thresholds: by the joints' torque limits")
        defaults = {**assumptions.defaults(arm), **options.thresholds}
        return dataclasses.replace(arm, home=home, defaults=defaults)

    def _check_names(self, key: str, given: Mapping[str, object], known: Mapping[str, object], what: str) -> None:
        for name in given:
            if name not in known:
                raise SettingsError(f"{self.file}: {key}: {what} '{name}' does not exist; known: {', '.join(known)}")

    def _only_tip(self, base: str) -> str:
        """The one link that is made for a tip, or the only one that ends a chain of joints, as a mere frame if any.

        What a gripper moves is no tip.
        """
        links = [link for link in self.tree.links if self._is_carried(base, link)]
        named = [link for link in links if _TIP.match(link)]
        ends = self._last(links)
        frames = [link for link in ends if not self.tree.links[link].findall("collision")]
        bare = [link for link in frames if not self.tree.links[link].findall("visual")]
        for found, what in (
            (self._last(named), "made for it"),
            (ends, "the last link"),
            (frames, "the only frame at the end of a chain of joints"),
            (bare, "the only frame at the end of a chain of joints"),
        ):
            if len(found) == 1:
                self.assumed.append(f"tip: {found[0]}, {what}")
                return found[0]
        raise SettingsError(
            f"{self.file}: {len(ends)} links end a chain of joints{':' * bool(ends)} {', '.join(ends)}; expected the "
            "one that is to reach the goals under tip"
        )

    def _is_carried(self, base: str, link: str) -> bool:
        """Whether a joint of an arm moves a link, and none of another kind after that one."""
        joints = [each for each in self.tree.chain(base, link) or [] if each.kind != "fixed"]
        joints = [each for each in joints if each.name not in self.options.fixed]
        return bool(joints) and joints[-1].kind in TURNING and not joints[-1].mimicked() and not _grips(joints[-1])

    def _last(self, links: Sequence[str]) -> list[str]:
        """Those links that are above no others of them."""
        above = {joint.parent for link in links for joint in self.tree.chain(self.tree.root, link) or []}
        return [link for link in links if link not in above]

    def _moving(self, base: str, tip: str) -> list[UrdfJoint]:
        """The joints between base and tip that move."""
        chain = self.tree.chain(base, tip)
        if chain is None:
            below = [link for link in self.tree.links if self.tree.chain(base, link)]
            raise SettingsError(
                f"{self.file}: tip '{tip}' is not below base '{base}'; expected one of {', '.join(below) or 'none'} "
                "under tip, or another base"
            )
        moving = [joint for joint in chain if joint.kind != "fixed" and not self._is_held(joint)]
        wrong = {joint.name: f"is of type {joint.kind}" for joint in moving if joint.kind not in TURNING}
        wrong |= {joint.name: f"mimics joint '{leader[0]}'" for joint in moving if (leader := joint.mimicked())}
        if wrong:
            found = "; ".join(f"joint '{name}' {what}" for name, what in wrong.items())
            fixed = ", ".join(f"{name}: 0.0" for name in wrong)
            raise SettingsError(
                f"{self.file}: between base '{base}' and tip '{tip}': {found}; expected {' or '.join(TURNING)} joints "
                f"that move on their own: hold others at a position under fixed ({{{fixed}}}), or choose another base "
                "or tip"
            )
        if not 2 <= len(moving) <= MAX_JOINTS:
            names = ", ".join(joint.name for joint in moving) or "none"
            raise SettingsError(
                f"{self.file}: {len(moving)} joints move between base '{base}' and tip '{tip}' ({names}); expected 2 "
                f"to {MAX_JOINTS}: hold others at a position under fixed, or choose another base or tip"
            )
        return moving

    def _model(self, moving: Sequence[UrdfJoint]) -> pin.Model:
        """What Pinocchio reads of all links; all joints but the moving ones are held."""
        robot, held = Element("robot", name=self.tree.name), {}
        waiting = [self.tree.root]
        while waiting:
            name = waiting.pop()
            self._add_link(robot, name)
            for joint in self.tree.below(name):
                waiting.append(joint.child)
                # Limits are checked elsewhere; joints of other types are only held, at 0 as a rule.
                kind = joint.kind if joint.kind in ("fixed", "prismatic") else "revolute"
                label = f"joint of {joint.child}"
                copied = SubElement(robot, "joint", name=label, type=kind)
                copied.extend(joint.element.findall("origin"))
                copied.extend(joint.element.findall("axis") if kind != "fixed" else ())
                SubElement(copied, "parent", link=_LINK + name)
                SubElement(copied, "child", link=_LINK + joint.child)
                SubElement(copied, "limit", dict.fromkeys(LIMITS, "0"))
                if joint not in moving and kind != "fixed":
                    held[label] = self._held_position(joint)
        model = pin.buildModelFromXML(ElementTree.tostring(robot, encoding="unicode"))
        q = pin.neutral(model)
        for name, position in held.items():
            q[model.idx_qs[model.getJointId(name)]] = position
        return pin.buildReducedModel(model, [model.getJointId(name) for name in held], q)

    def _add_link(self, robot: Element, name: str) -> None:
        """Add a link with its inertia."""
        link, inertia = SubElement(robot, "link", name=_LINK + name), self._own_inertia(name)
        if inertia is not None:
            inertial = SubElement(link, "inertial")
            SubElement(inertial, "origin", xyz=numbers(inertia.lever))
            SubElement(inertial, "mass", value=repr(inertia.mass))
            SubElement(inertial, "inertia", dict(zip(TENSOR, map(repr, tensor_values(inertia.inertia)), strict=True)))

    def _own_inertia(self, name: str) -> pin.Inertia | None:
        """The inertia of a link in its frame in the file: the given one, or the file's; None without a mass."""
        given, found = self.options.inertias.get(name), self.tree.links[name].find("inertial")
        if given is not None:
            return pin.Inertia(given.mass, np.array(given.center), tensor_matrix(given.tensor))
        mass = 0.0 if found is None else numbers_in(found, "mass", ("value",)).get("value", 0.0)
        if found is None or not mass > 0.0:
            return None
        tensor = dict.fromkeys(TENSOR, 0.0) | numbers_in(found, "inertia", TENSOR)
        about_center = pin.Inertia(mass, np.zeros(3), tensor_matrix(tuple(tensor[key] for key in TENSOR)))
        return placement(found.find("origin")).act(about_center)

    def _is_held(self, joint: UrdfJoint) -> bool:
        """Whether the options hold a joint, or the one that it mimics."""
        mimicked = joint.mimicked()
        held = joint.name in self.options.fixed
        return held or (mimicked is not None and self._is_held(self.tree.joints[mimicked[0]]))

    def _held_position(self, joint: UrdfJoint) -> float:
        """Position at which a joint is held, rad or m: as the options have it, as its leader's, or the nearest to 0."""
        position = self.options.fixed.get(joint.name)
        if position is not None:
            return position
        if mimicked := joint.mimicked():
            leader, multiplier, offset = mimicked
            return multiplier * self._held_position(self.tree.joints[leader]) + offset
        limits = {**joint.limits(), **self.options.limits.get(joint.name, {})}
        position = min(max(0.0, limits.get("lower", -math.inf)), limits.get("upper", math.inf))
        assumption = f"fixed: {joint.name} at {position:g}, since it is not between base and tip"
        self.assumed += [assumption] * (assumption not in self.assumed)
        return position

    def _joint(self, joint: UrdfJoint, place: pin.SE3, armature: float) -> Joint:
        given = self.options.limits.get(joint.name, {})
        limits = {**joint.limits(), **given}
        if joint.is_endless and not {"lower", "upper"} & set(given):
            self.assumed.append(f"limits: {joint.name}, which is continuous, turns once to either side")
        elif joint.soft_limits and not joint.soft_limits.keys() <= set(given):
            self.assumed.append(
                f"limits: {joint.name} from {limits['lower']:g} to {limits['upper']:g} rad, its soft ones"
            )
        lower, upper, velocity, effort = (limits.get(key, math.nan) for key in LIMITS)
        accepted = {"lower": lower < upper, "upper": lower < upper, "velocity": velocity > 0.0}
        accepted["effort"] = effort >= LEAST_EFFORT
        wrong = {key: limits.get(key) for key in LIMITS if not accepted[key]}
        if wrong:
            self.faults.limits(joint.name, wrong)
        # Without the rounding errors of a base that is turned about the vertical.
        offset, turn = vector(np.round(place.translation, _DIGITS)), _quaternion(place.rotation)
        return Joint(joint.name, offset, turn, lower, upper, velocity, effort, armature)

    def _show_visuals(self, parts: Sequence[Part]) -> None:
        """Let visual geometry stand for that of moving parts, and of fixed bodies, which have no other.

        Fixed links without a mass are taken for marks, unless no fixed link has any geometry that counts.
        """
        shown = []
        bodies = [(name,) for name in parts[0].places if self._own_inertia(name) is not None]
        for names in (*bodies, *(tuple(part.places) for part in parts)):
            links = [self.tree.links[name] for name in names]
            if any(link.find("collision") is not None for link in links) or set(names) & set(self.options.capsules):
                continue
            visuals = [(link, visual) for link in links for visual in link.findall("visual")]
            for link, visual in visuals:
                visual.tag = "collision"
                check_numbers(link, f"{self.file}: link '{link.get('name')}'")
            shown += [link.get("name", "") for link, _ in visuals]
        if shown:
            self.assumed.append(
                f"capsules: by visual geometry, since there is no other: {', '.join(dict.fromkeys(shown))}"
            )


def _parts(model: pin.Model, base: str, moving: Sequence[UrdfJoint]) -> list[Part]:
    """The base and the moving links, each with the links that are fixed to it."""
    parts = [Part(base, model.frames[model.getFrameId(_LINK + base)].placement.copy(), {})]
    for number, joint in enumerate(moving, 1):
        axis = model.joints[number].createData().S[3:]
        parts.append(Part(joint.child, pin.SE3(frame_about(axis), np.zeros(3)), {}))
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            part = parts[frame.parentJoint]
            part.places[frame.name.removeprefix(_LINK)] = part.turn.actInv(frame.placement)
    return parts


def _inertia(part: Part, lumped: pin.Inertia) -> Inertia:
    """Of a link with all that is fixed to it, in its turned frame; `lumped`: in its own."""
    turned = part.turn.actInv(lumped)
    return Inertia(float(turned.mass), vector(turned.lever), tensor_values(turned.inertia))


def _armature(joint: UrdfJoint, given: float | None) -> float:
    """Of a joint, kg m²: the given one, or what its description says."""
    own = numbers_in(joint.element, "dynamics", ("armature",)).get("armature", ARMATURE)
    return own if given is None else given


def _grips(joint: UrdfJoint) -> bool:
    return bool(_GRIPPER.search(f"{joint.name} {joint.child}")) or "gripper" in joint.name.lower()


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """As (w, x, y, z), without the rounding errors of angles that URDFs write with ten digits."""
    found = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    w, x, y, z = (0.0 if abs(value) < _ROUNDING else float(value) for value in found)
    return (1.0, 0.0, 0.0, 0.0) if x == y == z == 0.0 else (w, x, y, z)


def read_arm_file(file: Path) -> Reading:
    """Read an arm from a table, a URDF, xacro or MJCF file, or the options of one.

    Options are in a YAML file beside the robot's file, by default of the same name.

    Raises
    ------
    SettingsError
        If the file cannot be read, has an unknown key, or is not the description of a serial arm; the message names
        file and key.
    """
    if file.suffix.lower() in DESCRIPTIONS:
        beside = _beside(file, _YAML)
        options = ArmOptions() if beside is None else converted(read_yaml(beside), ArmOptions, str(beside))
        return read_arm(file, options, beside)
    content = read_yaml(file)
    if _OF_TABLES in content:
        return Reading(arm_of_table(content, str(file)), {}, [], [])
    options = converted(content, ArmOptions, str(file))
    robot = file.parent / options.urdf if options.urdf else _beside(file, DESCRIPTIONS) or file.with_suffix(".urdf")
    return read_arm(robot, options, file)


def _beside(file: Path, endings: Sequence[str]) -> Path | None:
    """The file of the same name with another ending, in any case: the first of these; `.urdf.xacro` is an ending."""
    found = [path for path in sorted(file.parent.glob("*")) if _stem(path) == _stem(file)]
    return next((path for ending in endings for path in found if path.suffix.lower() == ending), None)


def _stem(file: Path) -> str:
    while file.suffix.lower() in (*DESCRIPTIONS, *_YAML):
        file = file.with_suffix("")
    return file.name
