"""What the flange carries: a gripper, a probe, a payload, and where their tip is."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm, Capsule, Inertia, Quaternion, Vector3
from contact_reach_ros.arm.kinematics import rotation_from_quaternion, tensor_matrix, tensor_values
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Settings, setting

_ROUNDING = 1e-3
"""Share of the greatest moment of inertia by which rounded values may violate what holds for every body."""
_DIGITS = 12
"""Decimals of what is composed: so the digest is the same on every machine."""

_NOTHING = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Tool(Settings):
    """Weight and shape of a tool, payload included; `Arm.with_tool` attaches it.

    Its frame is that of the flange: the arm's tip frame without a tool. By default there is none.
    """

    mass: float = setting(0.0, "mass of tool and payload", unit="kg", minimum=0.0, maximum=50.0)
    center: tuple[float, float, float] = setting(
        _NOTHING, "centre of mass in the flange frame", unit="m", minimum=-1.0, maximum=1.0
    )
    inertia: tuple[float, float, float, float, float, float] = setting(
        (*_NOTHING, *_NOTHING),
        "inertia about the centre of mass in the axes of the flange frame: xx, yy, zz, xy, xz, yz",
        unit="kg m²",
        minimum=-10.0,
        maximum=10.0,
    )
    flange_to_tip: tuple[float, float, float, float, float, float] = setting(
        (*_NOTHING, *_NOTHING),
        "tip frame in the flange frame: x, y, z in m, then rotations about the flange's x, y and z axes, in that "
        "order, in rad",
        minimum=-3.15,
        maximum=3.15,
    )
    radius: float = setting(
        0.0,
        "radius of a capsule from flange to tip that may touch things; 0 for none",
        unit="m",
        minimum=0.0,
        maximum=0.3,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mass == 0.0:
            for name in ("center", "inertia"):
                if any(getattr(self, name)):
                    raise SettingsError(f"Tool.{name} = {getattr(self, name)}: expected zeros, as mass = 0 kg")
        least, middle, greatest = np.linalg.eigvalsh(tensor_matrix(self.inertia)).tolist()
        allowance = _ROUNDING * max(abs(least), greatest)
        if least < -allowance or least + middle < greatest - allowance:
            moments = ", ".join(f"{value:.3g}" for value in (least, middle, greatest))
            raise SettingsError(
                f"Tool.inertia = {self.inertia}: its principal moments are {moments} kg m²; expected none below zero "
                "and none above the sum of the others, as for every body: look at the order xx, yy, zz, xy, xz, yz"
            )
        if self.radius and not any(self.flange_to_tip[:3]):
            raise SettingsError(
                f"Tool.radius = {self.radius:g} m: expected 0 where flange_to_tip leads nowhere, as there is no capsule"
            )

    @property
    def position(self) -> Vector3:
        """Position of the tip in the flange frame, m."""
        return self.flange_to_tip[:3]

    @property
    def rotation(self) -> Quaternion:
        """Rotation (w, x, y, z) of the tip frame in the flange frame."""
        roll, pitch, yaw = (0.5 * angle for angle in self.flange_to_tip[3:])
        about_z, about_y = (math.cos(yaw), 0.0, 0.0, math.sin(yaw)), (math.cos(pitch), 0.0, math.sin(pitch), 0.0)
        return _product(_product(about_z, about_y), (math.cos(roll), math.sin(roll), 0.0, 0.0))


NO_TOOL = Tool()


def attach(arm: Arm, tool: Tool) -> Arm:
    """The arm with a tool at its tip, as `Arm.with_tool`."""
    if tool == NO_TOOL:
        return arm
    turn, flange = rotation_from_quaternion(arm.tip_rotation), np.array(arm.tip_offset)
    tip = _rounded(flange + turn @ tool.position)
    is_turned = any(tool.flange_to_tip[3:])
    tensor = _rounded(tensor_values(turn @ tensor_matrix(tool.inertia) @ turn.T))
    carried = Inertia(tool.mass, _rounded(flange + turn @ tool.center), tensor)
    inertia_sets = {
        name: (*inertias[:-1], _together(inertias[-1], carried)) if tool.mass else inertias
        for name, inertias in arm.inertia_sets.items()
    }
    shape = (Capsule(arm.n, arm.tip_offset, tip, tool.radius),) if tool.radius else ()
    return dataclasses.replace(
        arm,
        tip_offset=tip,
        tip_rotation=_rounded(_product(arm.tip_rotation, tool.rotation)) if is_turned else arm.tip_rotation,
        inertia_sets=inertia_sets,
        capsules=(*arm.capsules, *shape),
        reach=arm.reach + float(np.linalg.norm(tool.position)),
        bare=arm.bare or arm,
    )


def _together(first: Inertia, second: Inertia) -> Inertia:
    """Two bodies as one, by the parallel axis theorem."""
    mass = first.mass + second.mass
    center = (first.mass * np.array(first.center) + second.mass * np.array(second.center)) / mass
    tensor = np.zeros((3, 3))
    for body in (first, second):
        lever = np.subtract(body.center, center)
        tensor += tensor_matrix(body.tensor) + body.mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    return Inertia(round(mass, _DIGITS), _rounded(center), _rounded(tensor_values(tensor)))


def _rounded(values: ArrayLike) -> Any:
    """The values as a tuple, rounded, without negative zeros."""
    return tuple((np.round(np.asarray(values, dtype=float), _DIGITS) + 0.0).tolist())


def _product(first: Quaternion, second: Quaternion) -> Quaternion:
    """The rotation `second`, then `first`, about the same fixed axes."""
    w, x, y, z = first
    a, b, c, d = second
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
