"""Arms in files: a URDF, xacro or MJCF file with the few choices that it leaves open, or a table."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm import assumptions, plausibility
from contact_reach_ros.arm.arm import Arm, Array, Inertia, Joint
from contact_reach_ros.arm.capsule_fit import Fit
from contact_reach_ros.arm.kinematics import tensor_values, vector
from contact_reach_ros.arm.link_capsules import Part, link_capsules
from contact_reach_ros.arm.model import RobotModel, spatial_inertia
from contact_reach_ros.arm.mount import gravity_of, in_words
from contact_reach_ros.arm.robot_file import DESCRIPTIONS, find_mesh, read_robot_file
from contact_reach_ros.arm.rotations import frame_about, quaternion_from_rotation
from contact_reach_ros.arm.table import (
    ARMATURE,
    MAX_JOINTS,
    ArmOptions,
    arm_of_table,
    check_gravity,
    check_lengths,
    completed,
    converted,
    gravity_in,
)
from contact_reach_ros.arm.urdf_tree import (
    ENDLESS,
    LIMITS,
    RANGE,
    TENSOR,
    TURNING,
    UrdfJoint,
    UrdfTree,
    check_numbers,
    numbers_in,
    placement,
    tree_of,
)
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.resources import VERSION, kept
from contact_reach_ros.settings import read_yaml, unknown_key

_YAML = (".yaml", ".yml")
_OF_TABLES = "joints"
"""Key that only a table has."""
_TIP = re.compile(r"(^|.*[_/])(tool0|tool_frame|tcp|attachment_site)$", re.IGNORECASE)
"""Names of frames that are made for tips."""
_GRIPPER = re.compile(r"jaw|finger|claw|knuckle|thumb", re.IGNORECASE)
"""In names of joints and of the links that they move, and gripper in those of joints: what grips is no part of the
arm."""
_ROUNDING = 1e-10
_TURNS = 4.0 * math.pi
"""Greatest position, rad or m, at which a joint without limits is held."""
_BESIDE = 0.01
"""How far beyond its limits a joint may be held, rad or m: these are rounded."""
_DIGITS = 12
"""Decimals of joints' places, m."""


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
    one link. What has been read before is kept in the user's cache.

    Raises `SettingsError` if the file is not that of a serial arm with revolute joints, or lacks something; the message
    names all links or joints, what was expected, and the key of `ArmOptions` that mends it.
    """
    options = options or ArmOptions()
    robot, assumed = read_robot_file(file, options)
    # What is read, and what reads it: meshes that capsules may be fitted to, and the modules of this folder.
    shapes = (link.findall("collision") or link.findall("visual") for link in robot.findall("link"))
    names = dict.fromkeys(mesh.get("filename", "") for each in shapes for shape in each for mesh in shape.iter("mesh"))
    meshes = {name: path for name in names if (path := find_mesh(name, file, options.packages)) is not None}
    reader = _Reader(tree_of(robot, file), meshes, file, options, assumed, options_file)
    read = [*meshes.items(), *((path.name, path) for path in sorted(Path(__file__).parent.glob("*.py")))]
    contents = [(name, hashlib.sha256(path.read_bytes()).hexdigest()) for name, path in read]
    return kept((VERSION, file, options, assumed, ElementTree.tostring(robot), contents), reader.read)


class _Reader:
    def __init__(
        self,
        tree: UrdfTree,
        meshes: Mapping[str, Path],
        file: Path,
        options: ArmOptions,
        assumed: Sequence[str],
        options_file: Path | None,
    ) -> None:
        self.tree, self.meshes, self.file, self.options = tree, meshes, file, options
        self.assumed = list(assumed)
        self.options_file = options_file or file.with_name(f"{_stem(file)}.yaml")
        self.source = f"{file} with {options_file}" if options_file else str(file)
        self.faults: list[plausibility.Fault] = []
        movable = {name: joint for name, joint in tree.joints.items() if joint.kind != "fixed"}
        for key in ("fixed", "limits"):
            self._check_names(key, getattr(options, key), movable, "movable joint")
        for key in ("inertias", "capsules"):
            self._check_names(key, getattr(options, key), tree.links, "link")
        for joint, given in options.limits.items():
            for key, value in given.items():
                if key not in LIMITS:
                    raise SettingsError(unknown_key(key, LIMITS, f"{file}: limits: {joint}"))
                if abs(value) >= ENDLESS[key]:
                    raise SettingsError(
                        f"{file}: limits: {joint}: {key} = {value:g}; expected less than {ENDLESS[key]:g}"
                    )
        self._moving_names: set[str] = set()

    def read(self) -> Reading:
        options, tree = self.options, self.tree
        base = options.base or tree.root
        self._check_names("base", {base: None}, tree.links, "link")
        tip = options.tip or self._only_tip(base)
        self._check_names("tip", {tip: None}, tree.links, "link")
        moving = self._moving(base, tip)
        self._moving_names = {joint.name for joint in moving}
        # As the description has it, unless it is given for all joints or each; MJCF has 0 where it says nothing.
        own = [numbers_in(joint.element, "dynamics", ("armature",)).get("armature") or ARMATURE for joint in moving]
        given = own if options.armature is None else options.armature
        armature = given if isinstance(given, Sequence) else [given] * len(moving)
        lists: dict[str, Sequence[float]] = {f"thresholds: {key}": list_ for key, list_ in options.thresholds.items()}
        lists |= {"armature": armature} | ({} if options.home is None else {"home": options.home})
        check_lengths(lists, len(moving), self.source)
        parts = self._parts(base, moving)
        joints, inertias = [], []
        for joint, part, own_armature in zip(moving, parts[1:], armature, strict=True):
            joints.append(self._joint(joint, part.mount, own_armature))
            inertias.append(self._inertia(part))
        plausibility.refuse(self.faults, self.file, self.options_file)
        tip_place = parts[-1].places[tip]
        at_root = parts[0].places[tree.root].rotation
        gravity = gravity_in(options, self.source) or gravity_of(at_root.T, tree.gravity)
        check_gravity(gravity, self.source)
        self._show_visuals(parts)
        fixed, links, fits = link_capsules(tree.links, self.meshes, self.file, options, parts, self.assumed)
        arm = Arm(
            name=options.name or tree.name,
            joints=tuple(joints),
            link_names=tuple(part.link for part in parts[1:]),
            base_frame=base,
            tip_frame=tip if tip != parts[-1].link else self._new_name(f"{tip}_tip"),
            tip_offset=vector(tip_place.translation),
            tip_rotation=_quaternion(tip_place.rotation),
            capsules=links,
            base_capsules=fixed,
            inertia_sets={"nominal": tuple(inertias)},
            shoulder=(0.0, 0.0, 0.0),
            reach=0.0,
            home=tuple(0.5 * (joint.lower + joint.upper) for joint in joints),
            defaults={},
            gravity=gravity,
        )
        if options.mount is None:
            self.assumed.append(f"mount: {tree.root} stands upright: {in_words(arm)}")
        arm = self._completed(arm)
        robot = RobotModel(arm)
        plausibility.refuse([*plausibility.too_weak(robot)], self.file, self.options_file)
        return Reading(arm, fits, self.assumed, plausibility.doubts(robot))

    def _completed(self, arm: Arm) -> Arm:
        """The arm with shoulder, reach, home and thresholds."""
        options = self.options
        arm = dataclasses.replace(arm, shoulder=assumptions.shoulder(arm))
        if options.reach is None:
            self.assumed.append("reach: 90 % of the greatest distance of the tip from the shoulder")
        arm = dataclasses.replace(arm, reach=assumptions.reach(arm))
        if options.home is None:
            self.assumed.append("home: a posture in front of the arm, far from singularities")
        home = assumptions.home(arm) if options.home is None else options.home
        if not options.thresholds:
            self.assumed.append("thresholds: by the joints' torque limits and inertias")
        reach = arm.reach if options.reach is None else options.reach
        arm = dataclasses.replace(arm, home=home, reach=reach, defaults=options.thresholds)
        return completed(arm, self.source)

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

    def _parts(self, base: str, moving: Sequence[UrdfJoint]) -> list[Part]:
        """The base and the moving links, each with the links that are fixed to it; all other joints are held."""
        tree, parts = self.tree, [Part(base, pin.SE3.Identity(), {})]

        def add(link: str, part: Part, at: pin.SE3) -> None:
            part.places[link] = at
            for joint in tree.below(link):
                if joint in moving:
                    turn = pin.SE3(frame_about(joint.axis), np.zeros(3))
                    parts.append(Part(joint.child, at * placement(joint.element.find("origin")) * turn, {}))
                    add(joint.child, parts[-1], turn.inverse())
                else:
                    add(joint.child, part, at * self._held_place(joint))

        at = pin.SE3.Identity()
        for joint in tree.chain(tree.root, base) or []:
            at = at * self._held_place(joint)
        add(tree.root, parts[0], at.inverse())
        return parts

    def _held_place(self, joint: UrdfJoint) -> pin.SE3:
        """Where the link of a joint that is held stands in the link before."""
        place = placement(joint.element.find("origin"))
        if joint.kind == "fixed":
            return place
        way = self._held_position(joint) * joint.axis
        moved = pin.SE3(np.eye(3), way) if joint.kind == "prismatic" else pin.SE3(pin.exp3(way), np.zeros(3))
        return place * moved

    def _inertia(self, part: Part) -> Inertia:
        """Of a moving link with all that is fixed to it."""
        own = {name: each for name in part.places if (each := self._own_inertia(name)) is not None}
        lumped = pin.Inertia.Zero()
        for name, each in own.items():
            lumped += part.places[name].act(each)
        self.faults += plausibility.wrong_inertias(part.link, lumped, own)
        return Inertia(float(lumped.mass), vector(lumped.lever), tensor_values(lumped.inertia))

    def _own_inertia(self, name: str) -> pin.Inertia | None:
        """The inertia of a link in its frame in the file: the given one, or the file's; None without a mass."""
        given, found = self.options.inertias.get(name), self.tree.links[name].find("inertial")
        if given is not None:
            return spatial_inertia(given)
        mass = 0.0 if found is None else numbers_in(found, "mass", ("value",)).get("value", 0.0)
        if found is None or mass == 0.0:
            return None
        xx, yy, zz, xy, xz, yz = (dict.fromkeys(TENSOR, 0.0) | numbers_in(found, "inertia", TENSOR)).values()
        about_center = spatial_inertia(Inertia(mass, (0.0, 0.0, 0.0), (xx, yy, zz, xy, xz, yz)))
        return placement(found.find("origin")).act(about_center)

    def _is_held(self, joint: UrdfJoint) -> bool:
        """Whether the options hold a joint, or the one that it mimics."""
        mimicked = joint.mimicked()
        return joint.name in self.options.fixed or bool(mimicked and self._is_held(self.tree.joints[mimicked[0]]))

    def _held_position(self, joint: UrdfJoint) -> float:
        """Position at which a joint is held, rad or m: as the options have it, as its leader's, or the nearest to 0."""
        position = self.options.fixed.get(joint.name)
        if position is not None:
            limits = {"lower": -_TURNS, "upper": _TURNS, **joint.limits()[0], **self.options.limits.get(joint.name, {})}
            unit = "m" if joint.kind == "prismatic" else "rad"
            if not limits["lower"] - _BESIDE <= position <= limits["upper"] + _BESIDE:
                within = f"from {limits['lower']:.6g} to {limits['upper']:.6g} {unit}"
                raise SettingsError(f"{self.file}: fixed: {joint.name} = {position:g}; expected {within}")
            return position
        if mimicked := joint.mimicked():
            leader, multiplier, offset = mimicked
            if leader in self._moving_names:
                raise SettingsError(
                    f"{self.file}: joint '{joint.name}' follows joint '{leader}', which moves the arm, and is not part "
                    "of its chain; the package knows no such arms. Where it moves next to nothing, hold it at a "
                    f"position under fixed ({{{joint.name}: 0.0}})"
                )
            return multiplier * self._held_position(self.tree.joints[leader]) + offset
        limits = {**joint.limits()[0], **self.options.limits.get(joint.name, {})}
        position = min(max(0.0, limits.get("lower", -math.inf)), limits.get("upper", math.inf))
        assumption = f"fixed: {joint.name} at {position:g}, since it is not between base and tip"
        self.assumed += [assumption] * (assumption not in self.assumed)
        return position

    def _joint(self, joint: UrdfJoint, place: pin.SE3, armature: float) -> Joint:
        given = self.options.limits.get(joint.name, {})
        limits, remark = joint.limits()
        limits |= given
        if remark and not given.keys() & set(RANGE):
            self.assumed.append(f"limits: {joint.name}{remark}")
        lower, upper, velocity, effort = (limits.get(key, math.nan) for key in LIMITS)
        accepted = (lower < upper, lower < upper, velocity > 0.0, effort >= plausibility.LEAST_EFFORT)
        if wrong := {key: limits.get(key) for key, is_right in zip(LIMITS, accepted, strict=True) if not is_right}:
            self.faults.append(plausibility.wrong_limits(joint.name, wrong))
        # Without the rounding errors of a base that is turned about the vertical.
        offset, turn = vector(np.round(place.translation, _DIGITS)), _quaternion(place.rotation)
        return Joint(joint.name, offset, turn, lower, upper, velocity, effort, armature)

    def _show_visuals(self, parts: Sequence[Part]) -> None:
        """Let visual geometry stand for that of links with a mass, and of moving parts, which have no other.

        Fixed links without a mass are taken for marks, unless no fixed link has any geometry that counts.
        """
        shown: list[str] = []
        bodies = [(name,) for part in parts for name in part.places if self._own_inertia(name) is not None]
        for names in (*bodies, *(tuple(part.places) for part in parts)):
            links = [self.tree.links[name] for name in names]
            if any(link.find("collision") is not None for link in links) or set(names) & set(self.options.capsules):
                continue
            visuals = [(link, visual) for link in links for visual in link.findall("visual")]
            for link, visual in visuals:
                visual.tag = "collision"
                check_numbers(link, f"{self.file}: link '{link.get('name')}'")
            shown += [link.get("name", "") for link, _ in visuals]
        marks = [name for name in parts[0].places if name not in self.options.capsules and self._is_mark(name)]
        self.assumed += [f"capsules: none on {name}, taken for a mark since it has no mass" for name in marks]
        if shown:
            self.assumed.append(
                f"capsules: by visual geometry, since there is no other: {', '.join(dict.fromkeys(shown))}"
            )

    def _new_name(self, name: str) -> str:
        """One that no link has."""
        return self._new_name(f"{name}_") if name in self.tree.links else name

    def _is_mark(self, name: str) -> bool:
        """Whether a link has only visual geometry."""
        link = self.tree.links[name]
        return link.find("collision") is None and link.find("visual") is not None


def _grips(joint: UrdfJoint) -> bool:
    return bool(_GRIPPER.search(f"{joint.name} {joint.child}")) or "gripper" in joint.name.lower()


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """As (w, x, y, z), without the rounding errors of angles that URDFs write with ten digits."""
    found = quaternion_from_rotation(rotation)
    w, x, y, z = (0.0 if abs(value) < _ROUNDING else value for value in found)
    return (1.0, 0.0, 0.0, 0.0) if x == y == z == 0.0 else (w, x, y, z)


def read_arm_file(file: Path) -> Reading:
    """Read an arm from a table, a URDF, xacro or MJCF file, or the options of one.

    Options are in a YAML file beside the robot's file, by default of the same name.

    Raises `SettingsError` if the file cannot be read, has an unknown key, or is not the description of a serial arm;
    the message names file and key.
    """
    if file.suffix.lower() in DESCRIPTIONS:
        beside = _beside(file, _YAML)
        options = ArmOptions() if beside is None else _options(read_yaml(beside, may_be_empty=True), beside)
        if options.urdf and beside is not None and (beside.parent / options.urdf).resolve() != file.resolve():
            raise SettingsError(f"{beside}: urdf = {options.urdf}, and not {file.name}; give {beside} as the arm")
        return read_arm(file, options, beside)
    content = read_yaml(file, may_be_empty=True)
    if _OF_TABLES in content:
        return Reading(arm_of_table(content, str(file)), {}, [], [])
    options = _options(content, file)
    robot = file.parent / options.urdf if options.urdf else _beside(file, DESCRIPTIONS) or file.with_suffix(".urdf")
    return read_arm(robot, options, file)


def _options(content: Mapping[str, Any], file: Path) -> ArmOptions:
    if _OF_TABLES in content:
        raise SettingsError(f"{file}: is a table, which holds the whole arm; give it by itself, or rename it")
    return converted(content, ArmOptions, str(file))


def _beside(file: Path, endings: Sequence[str]) -> Path | None:
    """The file of the same name with another ending, in any case: the first of these; `.urdf.xacro` is an ending."""
    found = [path for path in sorted(file.parent.glob("*")) if _stem(path) == _stem(file)]
    return next((path for ending in endings for path in found if path.suffix.lower() == ending), None)


def _stem(file: Path) -> str:
    while file.suffix.lower() in (*DESCRIPTIONS, *_YAML):
        file = file.with_suffix("")
    return file.name
