"""Arms in files: a URDF with the few choices that it leaves open, or a table.

Pinocchio reads frames and inertias of a URDF, and lumps what is fixed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import assumptions
from contact_reach_ros.arm.arm import Arm, Inertia, Joint, Vector3
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import Fit, frame_about
from contact_reach_ros.arm.kinematics import rotation_about
from contact_reach_ros.arm.link_capsules import Part, link_capsules, vector
from contact_reach_ros.arm.mjcf import numbers
from contact_reach_ros.arm.mount import gravity_of, in_words
from contact_reach_ros.arm.table import ArmOptions, arm_of_table, check_lengths, converted, gravity_in
from contact_reach_ros.arm.urdf_tree import LIMITS, TENSOR, TURNING, UrdfJoint, UrdfTree, read_urdf
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import read_yaml

MAX_JOINTS = 7
_YAML = (".yaml", ".yml")
_OF_TABLES = "joints"
"""Key that only a table has."""
_TURN = round(2.0 * math.pi, 4)
_ROUNDING = 1e-10
_LINK = "link "
"""Prefix of links for Pinocchio, which finds frames by name: neither joints nor its universe have such a name."""


class Reading(NamedTuple):
    """An arm, and how it came about."""

    arm: Arm
    fits: dict[str, Fit]
    """The capsules that were fitted, by link."""
    assumed: list[str]
    """What neither the URDF nor the options say, in words."""


def read_arm(file: Path, options: ArmOptions | None = None) -> Reading:
    """Make an arm of a URDF.

    Each link's frame is the URDF's, turned so that the joint turns about its z axis; links joined by fixed joints are
    one link.

    Raises
    ------
    SettingsError
        If the URDF is not that of a serial arm with revolute joints, or lacks something; the message names link or
        joint, what was expected, and the key of `ArmOptions` that mends it.
    """
    return _Reader(read_urdf(file), file, options or ArmOptions()).read()


class _Reader:
    def __init__(self, tree: UrdfTree, file: Path, options: ArmOptions) -> None:
        self.tree, self.file, self.options = tree, file, options
        self.assumed: list[str] = []
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
        armature = options.armature if isinstance(options.armature, tuple) else (options.armature,) * len(moving)
        lists: dict[str, Sequence[float]] = {f"thresholds: {key}": list_ for key, list_ in options.thresholds.items()}
        lists |= {"armature": armature} | ({} if options.home is None else {"home": options.home})
        check_lengths(lists, len(moving), str(self.file))
        model = self._model(base, moving)
        parts = _parts(model, base, moving)
        joints, inertias = [], []
        for number, (joint, own_armature) in enumerate(zip(moving, armature, strict=True), 1):
            place = parts[number - 1].turn.actInv(model.jointPlacements[number]) * parts[number].turn
            joints.append(self._joint(joint, place, own_armature))
            inertias.append(self._inertia(parts[number], model.inertias[number]))
        tip_place = parts[-1].places[tip]
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
            base_capsule=found.base,
            inertia_sets={"nominal": tuple(inertias)},
            shoulder=(0.0, 0.0, 0.0),
            reach=0.0,
            home=tuple(0.5 * (joint.lower + joint.upper) for joint in joints),
            defaults={},
            gravity=gravity_in(options, str(self.file)) or self._gravity(base),
        )
        if options.mount is None:
            self.assumed.append(f"mount: {tree.root} stands upright: {in_words(arm)}")
        return Reading(self._completed(arm), found.fits, self.assumed)

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
        """The only link that ends a chain of joints, or the only one of them that is a mere frame."""
        ends = [link for link in self.tree.links if not self.tree.below(link) and self._turns(base, link)]
        frames = [link for link in ends if self.tree.links[link].find("collision") is None]
        for found, what in ((ends, "the last link"), (frames, "the only frame at the end of a chain of joints")):
            if len(found) == 1:
                self.assumed.append(f"tip: {found[0]}, {what}")
                return found[0]
        raise SettingsError(
            f"{self.file}: {len(ends)} links end a chain of joints: {', '.join(ends)}; expected the one that is to "
            "reach the goals under tip"
        )

    def _gravity(self, base: str) -> Vector3:
        """Gravity in the base frame, m/s², where the root's z axis points up."""
        turn = np.eye(3)
        for joint in self.tree.chain(self.tree.root, base) or []:
            turn = turn @ pin.rpy.rpyToMatrix(_numbers(joint.element, "origin", "rpy", "0 0 0"))
            if joint.kind in TURNING:
                axis = _numbers(joint.element, "axis", "xyz", "1 0 0")
                turn = turn @ rotation_about(axis / np.linalg.norm(axis), self._held_position(joint))
        return gravity_of(turn)

    def _turns(self, base: str, tip: str) -> bool:
        """Whether any joint turns between two links."""
        return any(joint.kind in TURNING for joint in self.tree.chain(base, tip) or [])

    def _moving(self, base: str, tip: str) -> list[UrdfJoint]:
        """The joints between base and tip that move."""
        chain = self.tree.chain(base, tip)
        if chain is None:
            below = [link for link in self.tree.links if self.tree.chain(base, link)]
            raise SettingsError(
                f"{self.file}: tip '{tip}' is not below base '{base}'; expected one of {', '.join(below) or 'none'} "
                "under tip, or another base"
            )
        moving = [joint for joint in chain if joint.kind != "fixed" and joint.name not in self.options.fixed]
        for joint in moving:
            hold = f"hold it at a position under fixed ({{{joint.name}: 0.0}}), or choose another base or tip"
            where = f"{self.file}: joint '{joint.name}', between base '{base}' and tip '{tip}',"
            if joint.kind not in TURNING:
                raise SettingsError(f"{where} is of type {joint.kind}; expected {' or '.join(TURNING)}: {hold}")
            if (mimic := joint.element.find("mimic")) is not None:
                raise SettingsError(
                    f"{where} mimics joint '{mimic.get('joint')}'; expected joints that move on their own: {hold}"
                )
        if not 2 <= len(moving) <= MAX_JOINTS:
            names = ", ".join(joint.name for joint in moving) or "none"
            raise SettingsError(
                f"{self.file}: {len(moving)} joints move between base '{base}' and tip '{tip}' ({names}); expected 2 "
                f"to {MAX_JOINTS}: hold others at a position under fixed, or choose another base or tip"
            )
        return moving

    def _model(self, base: str, moving: Sequence[UrdfJoint]) -> pin.Model:
        """What Pinocchio reads of the links below the base; all joints but the moving ones are held."""
        robot, held = Element("robot", name=self.tree.name), {}
        waiting = [base]
        while waiting:
            name = waiting.pop()
            self._add_link(robot, name)
            for joint in self.tree.below(name):
                waiting.append(joint.child)
                # Limits are checked elsewhere; joints of other types are only held, at 0 as a rule.
                kind = joint.kind if joint.kind in ("fixed", "prismatic") else "revolute"
                label = f"joint of {joint.child}"
                copied = SubElement(robot, "joint", name=label, type=kind)
                copied.extend(each for each in joint.element if each.tag in ("origin", "axis"))
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
        """Add a link with its inertia: the given one, or the URDF's."""
        link = SubElement(robot, "link", name=_LINK + name)
        given, own = self.options.inertias.get(name), self.tree.links[name].find("inertial")
        if given is not None:
            inertial = SubElement(link, "inertial")
            SubElement(inertial, "origin", xyz=numbers(given.center))
            SubElement(inertial, "mass", value=repr(given.mass))
            SubElement(inertial, "inertia", dict(zip(TENSOR, map(repr, given.tensor), strict=True)))
        elif own is not None and (mass := own.find("mass")) is not None and float(mass.get("value", "0")) > 0.0:
            inertia = own.find("inertia")
            inertia = SubElement(own, "inertia") if inertia is None else inertia
            inertia.attrib.update({key: inertia.get(key, "0") for key in TENSOR})
            link.append(own)

    def _held_position(self, joint: UrdfJoint) -> float:
        """Position at which a joint is held, rad or m: as the options have it, or the nearest to 0."""
        position = self.options.fixed.get(joint.name)
        if position is None:
            limits = {**joint.limits(), **self.options.limits.get(joint.name, {})}
            position = min(max(0.0, limits.get("lower", -math.inf)), limits.get("upper", math.inf))
            self.assumed.append(f"fixed: {joint.name} at {position:g}, since it is not between base and tip")
        return position

    def _joint(self, joint: UrdfJoint, place: pin.SE3, armature: float) -> Joint:
        limits = {**joint.limits(), **self.options.limits.get(joint.name, {})}
        if joint.kind == "continuous" and not {"lower", "upper"} & set(limits):
            self.assumed.append(f"limits: {joint.name}, which is continuous, turns once to either side")
            limits |= {"lower": -_TURN, "upper": _TURN}
        for key in LIMITS:
            if key not in limits:
                raise SettingsError(
                    f"{self.file}: joint '{joint.name}' has no {key} limit; expected one in the URDF, or under "
                    f"limits ({{{joint.name}: {{{key}: ...}}}})"
                )
        if not limits["lower"] < limits["upper"]:
            raise SettingsError(
                f"{self.file}: joint '{joint.name}' has limits from {limits['lower']:g} to {limits['upper']:g} rad; "
                f"expected lower < upper, in the URDF or under limits ({{{joint.name}: ...}})"
            )
        return Joint(
            joint.name,
            vector(place.translation),
            _quaternion(place.rotation),
            limits["lower"],
            limits["upper"],
            limits["velocity"],
            limits["effort"],
            armature,
        )

    def _inertia(self, part: Part, lumped: pin.Inertia) -> Inertia:
        """Of a link with all that is fixed to it, in its turned frame; `lumped`: in its own."""
        where = f"{self.file}: link '{part.link}'"
        mend = f"in the URDF, or under inertias ({{{part.link}: {{mass: ..., center: ..., tensor: ...}}}})"
        if not lumped.mass > 0.0:
            raise SettingsError(f"{where} has no mass; expected an inertia with a mass above 0 kg {mend}")
        moments = np.linalg.eigvalsh(lumped.inertia)
        if not (moments[0] > 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-6)):
            raise SettingsError(
                f"{where} has principal moments of inertia {np.array2string(moments, precision=3)} kg m², as no "
                f"body has; expected them above 0, none above the sum of the others, {mend}"
            )
        turned = part.turn.actInv(lumped)
        xx, yy, zz, xy, xz, yz = (
            float(turned.inertia[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        )
        return Inertia(float(turned.mass), vector(turned.lever), (xx, yy, zz, xy, xz, yz))


def _parts(model: pin.Model, base: str, moving: Sequence[UrdfJoint]) -> list[Part]:
    """The base and the moving links, each with the links that are fixed to it."""
    parts = [Part(base, pin.SE3.Identity(), {})]
    for number, joint in enumerate(moving, 1):
        axis = model.joints[number].createData().S[3:]
        parts.append(Part(joint.child, pin.SE3(frame_about(axis), np.zeros(3)), {}))
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            part = parts[frame.parentJoint]
            part.places[frame.name.removeprefix(_LINK)] = part.turn.actInv(frame.placement)
    return parts


def _numbers(element: Element, tag: str, key: str, default: str) -> Array:
    found = element.find(tag)
    return np.array((default if found is None else found.get(key, default)).split(), float)


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """As (w, x, y, z), without the rounding errors of angles that URDFs write with ten digits."""
    found = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    w, x, y, z = (0.0 if abs(value) < _ROUNDING else float(value) for value in found)
    return (1.0, 0.0, 0.0, 0.0) if x == y == z == 0.0 else (w, x, y, z)


def read_arm_file(file: Path) -> Reading:
    """Read an arm from a table, a URDF, or the options of a URDF.

    Options are in a YAML file beside the URDF, by default of the same name.

    Raises
    ------
    SettingsError
        If the file cannot be read, has an unknown key, or is not the description of a serial arm; the message names
        file and key.
    """
    if file.suffix == ".urdf":
        beside = next((file.with_suffix(ending) for ending in _YAML if file.with_suffix(ending).is_file()), None)
        options = ArmOptions() if beside is None else converted(read_yaml(beside), ArmOptions, str(beside))
        return read_arm(file, options)
    content = read_yaml(file)
    if _OF_TABLES in content:
        return Reading(arm_of_table(content, str(file)), {}, [])
    options = converted(content, ArmOptions, str(file))
    return read_arm(file.parent / options.urdf if options.urdf else file.with_suffix(".urdf"), options)
