"""What YAML files say of arms: all numbers of one, or what its URDF leaves open."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec
import numpy as np

from contact_reach_ros.arm import assumptions
from contact_reach_ros.arm.arm import Arm, Array, Inertia, Vector3
from contact_reach_ros.arm.model import spatial_inertia
from contact_reach_ros.arm.mount import mounted
from contact_reach_ros.arm.plausibility import wrong_inertias
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import unknown_key

MOUNT = "mount"
_FULL_TURN = 6.3
_MOST = 1e9
"""Of any number, in units of the SI."""
_SLACK = 1e-3
"""Of the reach, as numbers in tables are rounded, m."""
_POSTURE = "reference_posture"
"""The one of `assumptions.defaults` that has angles, of any sign."""
_WEAK, _STRONG = 0.1, 100.0
"""Bounds of gravity, m/s²."""

MAX_JOINTS = 7
_MOST_TURNS = 25.0
"""Angle that limits of an arm's joints never have, rad: four turns, or a number in degrees."""

ARMATURE = 0.01
"""Reflected inertia of motor and gears unless it is given, kg m²."""

T = TypeVar("T")


@dataclass(frozen=True)
class GivenCapsule:
    """A capsule in the frame that its link has in the URDF, m."""

    start: Vector3
    end: Vector3
    radius: float


@dataclass(frozen=True)
class ArmOptions:
    """What a YAML file beside a robot's file may say; all of it has a default where the URDF leaves no choice."""

    urdf: str = ""
    """Path of the URDF, xacro or MJCF file, from the YAML file's folder; by default the one of the same name."""
    name: str = ""
    """By default the URDF's."""
    base: str = ""
    """Link that goals are given in; by default the root."""
    tip: str = ""
    """Link that is to reach the goals; by default the only one without a joint below it."""
    home: tuple[float, ...] | None = None
    """Joint angles, rad; by default a posture in front of the arm that is far from singularities."""
    mount: Vector3 | None = None
    """Roll, pitch and yaw of the base in a world whose z axis points up, rad; by default as the root of the URDF has
    it, whose z axis is taken to point up."""
    fixed: Mapping[str, float] = field(default_factory=dict)
    """Positions at which joints are held, rad or m; joints outside the chain are held at 0, or at the nearest limit."""
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """By joint: lower, upper, velocity and effort, instead of the URDF's."""
    inertias: Mapping[str, Inertia] = field(default_factory=dict)
    """By link, in its frame in the URDF, instead of the URDF's; without the links that are fixed to it."""
    capsules: Mapping[str, tuple[GivenCapsule, ...]] = field(default_factory=dict)
    """By link, instead of the one around its collision geometry."""
    packages: Mapping[str, str] = field(default_factory=dict)
    """Folders of ROS packages that meshes and xacro files are in."""
    xacro: Mapping[str, str | int | float | bool] = field(default_factory=dict)
    """Arguments of a xacro file."""
    armature: float | tuple[float, ...] | None = None
    """Reflected inertia of motors and gears, for all joints or each, kg m²; by default the MJCF's, or `ARMATURE`."""
    reach: float | None = None
    """Greatest distance of the tip from the shoulder at which goals are accepted, m."""
    thresholds: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Settings with a value for each joint, by name: those of the contact budget and the observer."""


def arm_of_table(content: Mapping[str, Any], source: str) -> Arm:
    """The arm of a table, whose keys are the attributes of `Arm`; thresholds that it lacks are by the rule.

    In place of `gravity` it may have `mount`, as `ArmOptions` have it.

    Raises `SettingsError` if a key is unknown or missing, or a value of the wrong type, or there is not one of
    something for each joint; the message begins with `source`.
    """
    if not isinstance(content, Mapping):
        raise SettingsError(f"{source}: holds {content!r}; expected a mapping")
    content = dict(content)
    if "base_capsule" in content:
        # Of before there were several, read until version 0.4.
        content["base_capsules"] = [content.pop("base_capsule")]
    if MOUNT in content:
        if "gravity" in content:
            raise SettingsError(f"{source}: has {MOUNT} and gravity, which follows from it; expected one of them")
        content["gravity"] = gravity_in(converted({MOUNT: content.pop(MOUNT)}, ArmOptions, source), source)
    arm = converted({"defaults": {}, **content}, Arm, source)
    check_gravity(arm.gravity, source)
    lists: dict[str, Any] = {"link_names": arm.link_names, "home": arm.home}
    lists |= {f"inertia_sets: {name}": values for name, values in arm.inertia_sets.items()}
    lists |= {f"defaults: {name}": values for name, values in arm.defaults.items()}
    check_lengths(lists, arm.n, source)
    for capsule in arm.capsules:
        if not 1 <= capsule.link <= arm.n:
            raise SettingsError(f"{source}: capsules: link = {capsule.link}; expected a number from 1 to {arm.n}")
    for capsule in arm.base_capsules:
        if capsule.link:
            raise SettingsError(f"{source}: base_capsules: link = {capsule.link}; expected 0, the base")
    return completed(arm, source)


def completed(arm: Arm, source: str) -> Arm:
    """The arm with the thresholds that it lacks, after a check that it can have its numbers, wherever they come from.

    Raises `SettingsError` with all that are wrong; the message begins with `source`.
    """
    known: dict[str, tuple[float, ...]] = {}
    wrong = [*_wrong(arm)]
    if not wrong:
        # They follow from the other numbers.
        known = assumptions.defaults(arm)
        wrong = [*_wrong_thresholds(arm, known)]
    if wrong:
        raise SettingsError(f"{source}: {'; '.join(wrong)}")
    return dataclasses.replace(arm, defaults={**known, **arm.defaults})


def _wrong(arm: Arm) -> Iterator[str]:
    if not 2 <= arm.n <= MAX_JOINTS:
        yield f"{arm.n} joints; expected 2 to {MAX_JOINTS}"
    for key, names in (("joints", arm.joint_names), ("link_names", arm.link_names)):
        if len({*names, ""}) <= len(names):
            yield f"{key}: {', '.join(map(repr, names))}; expected names, and none twice"
    if "universe" in arm.joint_names:
        # With it Pinocchio ends the process.
        yield "joint 'universe' has the name that Pinocchio has for the base; expected another"
    for key, name in (("base_frame", arm.base_frame), ("tip_frame", arm.tip_frame)):
        if name in arm.link_names:
            yield f"{key} '{name}' is a moving link, too; expected a name of its own"
    for joint, angle in zip(arm.joints, arm.home, strict=True):
        if not -_MOST_TURNS <= joint.lower < joint.upper <= _MOST_TURNS:
            limits = f"lower {joint.lower:g}, upper {joint.upper:g}"
            yield f"joint '{joint.name}' has {limits}; expected lower < upper, in rad, within ±{_MOST_TURNS:.3g}"
        elif not joint.lower <= angle <= joint.upper:
            within = f"[{joint.lower:g}, {joint.upper:g}]"
            yield f"home has {angle:g} rad for joint '{joint.name}'; expected an angle in {within} rad"
        for key, value in (("velocity_limit", joint.velocity_limit), ("torque_limit", joint.torque_limit)):
            if not value > 0.0:
                yield f"joint '{joint.name}' has {key} {value:g}; expected a number above 0"
        if not joint.armature >= 0.0:
            yield f"joint '{joint.name}' has armature {joint.armature:g}; expected a number of at least 0, kg m²"
    for name, rotation in (*((joint.name, joint.rotation) for joint in arm.joints), ("the tip", arm.tip_rotation)):
        if not any(rotation):
            yield f"the rotation of {name} is {list(rotation)}; expected a quaternion, as [w, x, y, z]"
    for inertias in arm.inertia_sets.values():
        for link, inertia in zip(arm.link_names, map(spatial_inertia, inertias), strict=True):
            yield from (fault.text for fault in wrong_inertias(link, inertia, {link: inertia}))
    for capsule in (*arm.capsules, *arm.base_capsules):
        if not capsule.radius > 0.0:
            yield f"a capsule of link {capsule.link} has radius {capsule.radius:g} m; expected a number above 0"
    # From the point of the first axis that is nearest to the second joint.
    levers = [joint.offset[:2] for joint in arm.joints[1:2]] + [joint.offset for joint in arm.joints[2:]]
    longest = math.dist(arm.shoulder, assumptions.shoulder(arm))
    longest += sum(math.hypot(*lever) for lever in (*levers, arm.tip_offset))
    if not 0.0 < arm.reach <= longest + _SLACK:
        yield f"reach = {arm.reach:g} m; expected a number above 0, and no more than the links' {longest:.3g} m"


def _wrong_thresholds(arm: Arm, known: Mapping[str, object]) -> Iterator[str]:
    for name, values in arm.defaults.items():
        if name not in known:
            yield unknown_key(name, list(known), "defaults", "threshold")
        elif name != _POSTURE and not min(values) >= 0.0:
            yield f"{name} = {list(values)}; expected numbers of at least 0"
    yield from excessive(arm.defaults, arm.torque_limits)


def excessive(thresholds: Mapping[str, Sequence[float]], limits: Array) -> Iterator[str]:
    """Which thresholds, N m, lie above the joints' torque limits (n,), so that nothing would stop the arm."""
    for name in ("torque_thresholds", "handover_thresholds"):
        if name in thresholds and (np.array(thresholds[name]) > limits).any():
            known = ", ".join(f"{limit:g}" for limit in limits)
            yield f"{name} = {list(thresholds[name])}; expected no more than the joints' torque limits, {known} Nm"


def check_gravity(gravity: Vector3, source: str) -> None:
    """Raise `SettingsError`, beginning with `source`, if no arm stands in this gravity, m/s²."""
    if not _WEAK < math.hypot(*gravity) < _STRONG:
        raise SettingsError(
            f"{source}: gravity = {list(gravity)}; expected its acceleration in the base frame, 9.81 m/s² in all"
        )


def gravity_in(options: ArmOptions, source: str) -> Vector3 | None:
    """Gravity in the base frame, m/s², as `mount` has it; None without.

    Raises `SettingsError` if the angles are no rotation in rad; the message begins with `source`.
    """
    if options.mount is None:
        return None
    if not all(abs(angle) <= _FULL_TURN for angle in options.mount):
        raise SettingsError(
            f"{source}: {MOUNT} = {list(options.mount)}; expected roll, pitch and yaw of the base in rad, each within "
            f"±{_FULL_TURN:g}"
        )
    return mounted(options.mount)


def check_lengths(lists: Mapping[str, Sequence[Any]], n: int, source: str) -> None:
    """Check that lists by key have a value for each of n joints.

    Raises `SettingsError` if one has not; the message begins with `source`.
    """
    for key, values in lists.items():
        if len(values) != n:
            raise SettingsError(f"{source}: {key} has {len(values)} values; expected {n}, one for each joint")


def table_of(arm: Arm) -> dict[str, Any]:
    """The table of an arm, which `arm_of_table` takes: numbers, strings, lists and mappings, as JSON has them."""
    table: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(arm))
    return table


def converted(content: Mapping[str, Any], kind: type[T], source: str) -> T:
    """The content of a file as a dataclass.

    Raises `SettingsError` if a key is unknown or missing, or a value of the wrong type; the message begins with
    `source`.
    """
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for key in content:
        if key not in known:
            raise SettingsError(unknown_key(str(key), known, source))
    try:
        made = msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{source}: {error}".replace("`$.", "`")) from error
    _check_keys(content, msgspec.to_builtins(made), source)
    return made


def _check_keys(given: Any, taken: Any, source: str) -> None:
    """Refuse keys, at any depth, that the conversion ignored, and numbers that no arm has."""
    if isinstance(given, Mapping):
        for key, value in given.items():
            if key not in taken:
                raise SettingsError(unknown_key(str(key), list(taken), source))
            _check_keys(value, taken[key], f"{source}: {key}")
    elif isinstance(given, list):
        for one, other in zip(given, taken, strict=True):
            _check_keys(one, other, source)
    elif isinstance(given, int | float) and not abs(given) <= _MOST:
        raise SettingsError(f"{source} = {given:g}; expected a finite number")
