"""What the flange carries: a gripper, a probe, a payload, and where their tip is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm, Capsule, Inertia
from contact_reach_ros.arm.kinematics import tensor_matrix, tensor_values
from contact_reach_ros.arm.model import spatial_inertia
from contact_reach_ros.arm.rotations import quaternion_from_rotation, rotation_from_quaternion
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


NO_TOOL = Tool()


def attach(arm: Arm, tool: Tool) -> Arm:
    """The arm with a tool at its tip, as `Arm.with_tool`."""
    if tool == NO_TOOL:
        return arm
    way, angles = tool.flange_to_tip[:3], tool.flange_to_tip[3:]
    turn = rotation_from_quaternion(arm.tip_rotation)
    flange = pin.SE3(turn, np.array(arm.tip_offset, float))
    tip = _rounded(flange.act(np.array(way)))
    turned = _rounded(quaternion_from_rotation(turn @ pin.rpy.rpyToMatrix(*angles)))
    carried = flange.act(spatial_inertia(Inertia(tool.mass, tool.center, tool.inertia)))
    inertia_sets = {
        name: (*inertias[:-1], _together(inertias[-1], carried)) if tool.mass else inertias
        for name, inertias in arm.inertia_sets.items()
    }
    shape = (Capsule(arm.n, arm.tip_offset, tip, tool.radius),) if tool.radius else ()
    return dataclasses.replace(
        arm,
        tip_offset=tip,
        tip_rotation=turned if any(angles) else arm.tip_rotation,
        inertia_sets=inertia_sets,
        capsules=(*arm.capsules, *shape),
        reach=arm.reach + float(np.linalg.norm(way)),
        bare=arm.bare or arm,
    )


def _together(link: Inertia, carried: pin.Inertia) -> Inertia:
    """A link with a body that is fixed to it, both in the link's frame."""
    body = carried + spatial_inertia(link)
    return Inertia(round(body.mass, _DIGITS), _rounded(body.lever), _rounded(tensor_values(body.inertia)))


def _rounded(values: ArrayLike) -> Any:
    """The values as a tuple, rounded, without negative zeros."""
    return tuple((np.round(np.asarray(values, dtype=float), _DIGITS) + 0.0).tolist())
