"""Arms in files: a URDF with the few choices that it leaves open, or a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import assumptions
from contact_reach_ros.arm.arm import Arm, Inertia, Joint
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import Fit, frame_about
from contact_reach_ros.arm.kinematics import tensor_matrix
from contact_reach_ros.arm.link_capsules import Part, link_capsules, vector
from contact_reach_ros.arm.table import ArmOptions, arm_of_table, converted
from contact_reach_ros.arm.urdf_tree import TURNING, UrdfJoint, UrdfTree, read_urdf
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import read_yaml

MAX_JOINTS = 7
_YAML = (".yaml", ".yml")
_OF_TABLES = "joints"
"""Key that only a table has."""
_TURN = round(2.0 * math.pi, 4)
_ROUNDING = 1e-10


class Reading(NamedTuple):
    """An arm, and how it came about."""

    arm: Arm
    fits: dict[str, Fit]
    """The capsules that were fitted, by link."""
    assumed: list[str]
    """What neither the URDF nor the options say, in words."""
    geometry: list[list[Array]]
    """What the capsules were fitted to, see `LinkCapsules`."""


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
        self._check_lengths(len(moving))
        armature = options.armature if isinstance(options.armature, tuple) else (options.armature,) * len(moving)
        parts = self._parts(base, moving)
        joints, inertias = [], []
        frame = np.eye(4)
        for before, part, joint, own_armature in zip(parts, parts[1:], moving, armature, strict=False):
            place = frame @ before.places[joint.parent] @ joint.place
            joints.append(self._joint(joint, place @ part.turn, own_armature))
            inertias.append(self._inertia(part))
            frame = part.turn.T
        tip_place = frame @ parts[-1].places[tip]
        found = link_capsules(tree, self.file, options, parts, joints[0])
        self.assumed += [f"capsules: none on {link}, which has no collision geometry" for link in found.bare]
        arm = Arm(
            name=options.name or tree.name,
            joints=tuple(joints),
            link_names=tuple(part.link for part in parts[1:]),
            base_frame=base,
            tip_frame=tip if tip != parts[-1].link else f"{tip}_tip",
            tip_offset=vector(tip_place[:3, 3]),
            tip_rotation=_quaternion(tip_place[:3, :3]),
            capsules=found.links,
            base_capsule=found.base,
            inertia_sets={"nominal": tuple(inertias)},
            shoulder=(0.0, 0.0, 0.0),
            reach=0.0,
            home=tuple(0.5 * (joint.lower + joint.upper) for joint in joints),
            defaults={},
        )
        return Reading(self._completed(arm), found.fits, self.assumed, found.geometry)

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

    def _check_lengths(self, n: int) -> None:
        lists = {"home": self.options.home, **{f"thresholds: {k}": v for k, v in self.options.thresholds.items()}}
        if isinstance(self.options.armature, tuple):
            lists["armature"] = self.options.armature
        for key, values in lists.items():
            if values is not None and len(values) != n:
                raise SettingsError(f"{self.file}: {key} has {len(values)} values; expected {n}, one for each joint")

    def _check_names(self, key: str, given: Mapping[str, object], known: Mapping[str, object], what: str) -> None:
        for name in given:
            if name not in known:
                raise SettingsError(f"{self.file}: {key}: {what} '{name}' does not exist; known: {', '.join(known)}")

    def _only_tip(self, base: str) -> str:
        """The only link that ends a chain of joints, or the only one of them that is a mere frame."""
        ends = [link for link in self.tree.links if not self.tree.below(link) and self._turns(base, link)]
        frames = [link for link in ends if not self.tree.links[link].shapes]
        for found, what in ((ends, "the last link"), (frames, "the only frame at the end of a chain of joints")):
            if len(found) == 1:
                self.assumed.append(f"tip: {found[0]}, {what}")
                return found[0]
        raise SettingsError(
            f"{self.file}: {len(ends)} links end a chain of joints: {', '.join(ends)}; expected the one that is to "
            "reach the goals under tip"
        )

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
            if joint.mimics:
                raise SettingsError(
                    f"{where} mimics joint '{joint.mimics}'; expected joints that move on their own: {hold}"
                )
        if not 2 <= len(moving) <= MAX_JOINTS:
            names = ", ".join(joint.name for joint in moving) or "none"
            raise SettingsError(
                f"{self.file}: {len(moving)} joints move between base '{base}' and tip '{tip}' ({names}); expected 2 "
                f"to {MAX_JOINTS}: hold others at a position under fixed, or choose another base or tip"
            )
        return moving

    def _parts(self, base: str, moving: Sequence[UrdfJoint]) -> list[Part]:
        """The base and the moving links, each with the links that are fixed to it."""
        heads = {joint.child: joint for joint in moving}
        parts = [Part(base, np.eye(4), {})]
        parts += [Part(joint.child, _transform(frame_about(joint.axis)), {}) for joint in moving]
        for part in parts:
            waiting = [(part.link, np.eye(4))]
            while waiting:
                name, place = waiting.pop()
                part.places[name] = place
                for below in self.tree.below(name):
                    if below.child not in heads:
                        waiting.append((below.child, place @ self._held(below)))
        return parts

    def _held(self, joint: UrdfJoint) -> Array:
        """The transform of a joint that does not move."""
        if joint.kind == "fixed":
            return joint.place
        limits = {**joint.limits, **self.options.limits.get(joint.name, {})}
        position = self.options.fixed.get(joint.name)
        if position is None:
            position = min(max(0.0, limits.get("lower", -math.inf)), limits.get("upper", math.inf))
            self.assumed.append(f"fixed: {joint.name} at {position:g}, since it is not between base and tip")
        motion = np.eye(4)
        if joint.kind == "prismatic":
            motion[:3, 3] = position * joint.axis
        else:
            motion[:3, :3] = Rotation.from_rotvec(position * joint.axis).as_matrix()
        return joint.place @ motion

    def _joint(self, joint: UrdfJoint, place: Array, armature: float) -> Joint:
        limits = {**joint.limits, **self.options.limits.get(joint.name, {})}
        if joint.kind == "continuous" and not {"lower", "upper"} & set(limits):
            self.assumed.append(f"limits: {joint.name}, which is continuous, turns once to either side")
            limits |= {"lower": -_TURN, "upper": _TURN}
        for key in ("lower", "upper", "velocity", "effort"):
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
            vector(place[:3, 3]),
            _quaternion(place[:3, :3]),
            limits["lower"],
            limits["upper"],
            limits["velocity"],
            limits["effort"],
            armature,
        )

    def _inertia(self, part: Part) -> Inertia:
        """Of a link with all that is fixed to it, in its turned frame."""
        bodies = []
        for name, place in part.places.items():
            given, own = self.options.inertias.get(name), self.tree.links[name].mass
            if given is not None:
                bodies.append((given.mass, place, np.array(given.center), tensor_matrix(given.tensor)))
            elif own is not None and own.mass > 0.0:
                bodies.append((own.mass, place, own.center, own.tensor))
        mass = sum(body[0] for body in bodies)
        where = f"{self.file}: link '{part.link}'"
        mend = f"in the URDF, or under inertias ({{{part.link}: {{mass: ..., center: ..., tensor: ...}}}})"
        if not mass > 0.0:
            raise SettingsError(f"{where} has no mass; expected an inertia with a mass above 0 kg {mend}")
        placed = [(each, *_placed(part.turn.T @ place, center, tensor)) for each, place, center, tensor in bodies]
        center = np.sum([each * at for each, at, _ in placed], axis=0) / mass
        total = np.zeros((3, 3))
        for each, at, tensor in placed:
            off = at - center
            total += tensor + each * ((off @ off) * np.eye(3) - np.outer(off, off))
        moments = np.linalg.eigvalsh(total)
        if not (moments[0] > 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-6)):
            raise SettingsError(
                f"{where} has principal moments of inertia {np.array2string(moments, precision=3)} kg m², as no "
                f"body has; expected them above 0, none above the sum of the others, {mend}"
            )
        xx, yy, zz, xy, xz, yz = (float(total[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        return Inertia(float(mass), vector(center), (xx, yy, zz, xy, xz, yz))


def _placed(place: Array, center: Array, tensor: Array) -> tuple[Array, Array]:
    """Centre (3,) and tensor (3, 3) of a body in the frame in which its own is at `place` (4, 4)."""
    rotation = place[:3, :3]
    return rotation @ center + place[:3, 3], rotation @ tensor @ rotation.T


def _transform(rotation: Array) -> Array:
    transform = np.eye(4)
    transform[:3, :3] = rotation
    return transform


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
        return Reading(arm_of_table(content, str(file)), {}, [], [])
    options = converted(content, ArmOptions, str(file))
    return read_arm(file.parent / options.urdf if options.urdf else file.with_suffix(".urdf"), options)
