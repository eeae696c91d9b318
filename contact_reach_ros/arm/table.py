"""What YAML files say of arms: all numbers of one, or what its URDF leaves open."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec
import yaml

from contact_reach_ros.arm import assumptions
from contact_reach_ros.arm.arm import Arm, Inertia, Vector3
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import unknown_key

_WIDTH = 100
"""Of lines in tables."""
_ROUNDING = 1e-10

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
    xacro: Mapping[str, str | float | bool] = field(default_factory=dict)
    """Arguments of a xacro file."""
    armature: float | tuple[float, ...] | None = None
    """Reflected inertia of motors and gears, for all joints or each, kg m²; by default the MJCF's, or `ARMATURE`."""
    reach: float | None = None
    """Greatest distance of the tip from the shoulder at which goals are accepted, m."""
    thresholds: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Settings with a value for each joint, by name: those of the contact budget and the observer."""


def arm_of_table(content: Mapping[str, Any], source: str) -> Arm:
    """The arm of a table, whose keys are the attributes of `Arm`; thresholds that it lacks are by the rule.

    Raises
    ------
    SettingsError
        If a key is unknown or missing, or a value of the wrong type, or there is not one of something for each joint;
        the message begins with `source`.
    """
    if "base_capsule" in content:
        # Of before there were several, read until version 0.4.
        content = {key: value for key, value in content.items() if key != "base_capsule"} | {
            "base_capsules": [content["base_capsule"]]
        }
    arm = converted({"defaults": {}, **content}, Arm, source)
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
    return dataclasses.replace(arm, defaults={**assumptions.defaults(arm), **arm.defaults})


def check_lengths(lists: Mapping[str, Sequence[Any]], n: int, source: str) -> None:
    """Check that lists by key have a value for each of n joints.

    Raises
    ------
    SettingsError
        If one has not; the message begins with `source`.
    """
    for key, values in lists.items():
        if len(values) != n:
            raise SettingsError(f"{source}: {key} has {len(values)} values; expected {n}, one for each joint")


def table_of(arm: Arm) -> dict[str, Any]:
    """The table of an arm, which `arm_of_table` takes: numbers, strings, lists and mappings, as JSON has them."""
    table: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(arm))
    return table


def table_text(arm: Arm, digits: int = 6) -> str:
    """The table of an arm as YAML, with numbers of so many significant digits, and 0 for rounding errors."""

    def rounded(number: str) -> float:
        return float(f"{float(number):.{digits}g}") if abs(float(number)) > _ROUNDING else 0.0

    table = json.loads(msgspec.json.encode(arm), parse_float=rounded)
    text: str = yaml.dump(table, sort_keys=False, default_flow_style=None, width=_WIDTH)
    return text


def converted(content: Mapping[str, Any], kind: type[T], source: str) -> T:
    """The content of a file as a dataclass.

    Raises
    ------
    SettingsError
        If a key is unknown or missing, or a value of the wrong type; the message begins with `source`.
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
    """Refuse keys, at any depth, that the conversion ignored."""
    if isinstance(given, Mapping):
        for key, value in given.items():
            if key not in taken:
                raise SettingsError(unknown_key(str(key), list(taken), source))
            _check_keys(value, taken[key], f"{source}: {key}")
    elif isinstance(given, list):
        for one, other in zip(given, taken, strict=True):
            _check_keys(one, other, source)
