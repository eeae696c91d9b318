"""What a URDF leaves open, as the YAML file beside it has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from contact_reach_ros.arm.arm import Inertia, Vector3

_ARMATURE = 0.01
"""Reflected inertia of motor and gears unless it is given, kg m²."""


@dataclass(frozen=True)
class GivenCapsule:
    """A capsule in the frame that its link has in the URDF, m."""

    start: Vector3
    end: Vector3
    radius: float


@dataclass(frozen=True)
class ArmOptions:
    """What a YAML file beside a URDF may say; all of it has a default where the URDF leaves no choice."""

    urdf: str = ""
    """Path of the URDF, from the YAML file's folder; by default the file of the same name."""
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
    """By link, instead of fitted ones; with those of the links that are fixed to it."""
    packages: Mapping[str, str] = field(default_factory=dict)
    """Folders of ROS packages that meshes are in."""
    armature: float | tuple[float, ...] = _ARMATURE
    """Reflected inertia of motors and gears, for all joints or each, kg m²."""
    reach: float | None = None
    """Greatest distance of the tip from the shoulder at which goals are accepted, m."""
    thresholds: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Settings with a value for each joint, by name: those of the contact budget and the observer."""
