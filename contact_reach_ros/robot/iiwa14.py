"""The KUKA LBR iiwa 14 R820 as one table: kinematics, limits, inertial parameters and collision capsules.

Every model in this package (MJCF for MuJoCo, Brax and Pinocchio, URDF for `robot_description`) is built from here.
Link frames rotate with their joint, whose axis is the local z. Units are SI: m, kg, rad, N m, s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from contact_reach_ros.errors import SettingsError

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

N_JOINTS = 7
JOINT_NAMES = tuple(f"lbr_A{number}" for number in range(1, N_JOINTS + 1))
LINK_NAMES = tuple(f"lbr_link_{number}" for number in range(1, N_JOINTS + 1))
BASE_NAME = "lbr_link_0"
FLANGE_NAME = "lbr_link_ee"

FLANGE_OFFSET: Vector3 = (0.0, 0.0, 0.045)
"""Flange in the frame of the last link, m; no rotation."""

ARMATURE = 0.01
"""Reflected motor inertia of every joint, kg m²: link 7 alone (0.001 kg m²) would be unphysically light."""

SHOULDER_POSITION: Vector3 = (0.0, 0.0, 0.36)
"""Where the axes of A1 to A3 meet, in the base frame, m."""

MAX_REACH = 0.85
"""Greatest distance of the flange from the shoulder at which a goal is accepted, m."""


@dataclass(frozen=True)
class Joint:
    """One revolute joint and the frame of the link that it moves, relative to the link before."""

    name: str
    offset: Vector3
    rotation: Quaternion
    """Rotation (w, x, y, z) of the link frame at angle zero, not normalised."""
    position_limit: float
    """Symmetric, rad."""
    velocity_limit: float
    """rad/s."""
    torque_limit: float
    """N m."""


@dataclass(frozen=True)
class Inertia:
    """Inertial parameters of one link in its frame; `tensor` is (xx, yy, zz, xy, xz, yz) about the centre of mass."""

    mass: float
    center: Vector3
    tensor: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Capsule:
    """Collision shape of one link, in its frame: a segment from `start` to `end` thickened by `radius`, m."""

    link: int
    start: Vector3
    end: Vector3
    radius: float


def _joint(
    number: int, offset: Vector3, rotation: Quaternion, limit_deg: float, speed_deg: float, torque: float
) -> Joint:
    return Joint(JOINT_NAMES[number - 1], offset, rotation, math.radians(limit_deg), math.radians(speed_deg), torque)


JOINTS = (
    _joint(1, (0, 0, 0.1575), (1, 0, 0, 0), 170, 85, 320),
    _joint(2, (0, 0, 0.2025), (0, 0, 1, 1), 120, 85, 320),
    _joint(3, (0, 0.2045, 0), (0, 0, 1, 1), 170, 100, 176),
    _joint(4, (0, 0, 0.2155), (1, 1, 0, 0), 120, 75, 176),
    _joint(5, (0, 0.1845, 0), (0, 0, 1, 1), 170, 130, 110),
    _joint(6, (0, 0, 0.2155), (1, 1, 0, 0), 120, 135, 40),
    _joint(7, (0, 0.081, 0), (0, 0, 1, 1), 175, 135, 40),
)

POSITION_LIMITS = tuple(joint.position_limit for joint in JOINTS)
VELOCITY_LIMITS = tuple(joint.velocity_limit for joint in JOINTS)
TORQUE_LIMITS = tuple(joint.torque_limit for joint in JOINTS)

HOME_POSITION = (0.0, math.radians(45), 0.0, math.radians(-90), 0.0, math.radians(45), 0.0)
"""Joint angles at which episodes start unless a scene says otherwise, rad."""

CAPSULES = (
    Capsule(2, (0, 0, 0), (0, 0.2045, 0), 0.095),
    Capsule(3, (0, 0, 0), (0, 0, 0.2155), 0.095),
    Capsule(4, (0, 0, 0), (0, 0.1845, 0), 0.08),
    Capsule(5, (0, 0, 0), (0, 0, 0.2155), 0.075),
    Capsule(6, (0, -0.01, 0), (0, 0.03, 0), 0.08),
    Capsule(7, (0, 0, -0.01), (0, 0, 0.03), 0.06),
)
"""Moving links that can touch the surroundings, numbered from 1 as the joints are."""

BASE_CAPSULE = Capsule(0, (0, 0, 0.05), (0, 0, 0.30), 0.11)
"""Base and the first link, which only turns about its own axis."""

_DIAGONAL = (0.0, 0.0, 0.0)

NOMINAL_INERTIAS = (
    Inertia(5.76, (0, -0.03, 0.12), (0.0333, 0.033, 0.0123, *_DIAGONAL)),
    Inertia(6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011, *_DIAGONAL)),
    Inertia(3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076, *_DIAGONAL)),
    Inertia(3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006, *_DIAGONAL)),
    Inertia(3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449, *_DIAGONAL)),
    Inertia(1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036, *_DIAGONAL)),
    Inertia(1.2, (0, 0, 0.02), (0.001, 0.001, 0.001, *_DIAGONAL)),
)
"""The common simulation set, in the link frames of `JOINTS`."""

ALIGNED_ORIGINS = (
    (0, 0, 0.1475),
    (0, -0.01, 0.2125),
    (0, 0.01, 0.228),
    (0, 0.0105, 0.192),
    (0, -0.0105, 0.2075),
    (0, -0.0707, 0.1925),
    (0, 0.0707, 0.091),
)
"""Second kinematic description: link frames parallel to the base at angle zero, m."""

ALIGNED_AXES = ((0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
"""Joint axes of the second description."""

ALIGNED_FLANGE_OFFSET: Vector3 = (0.0, 0.0, 0.035)

ALIGNED_INERTIAS = (
    Inertia(5.289529, (0, -0.033795, 0.132404), (0.042462, 0.042838, 0.01587, 0, 0, 0.006341)),
    Inertia(5.688888, (0.000136, 0.047548, 0.076322), (0.055182, 0.053983, 0.016523, 0, 0, 0.010034)),
    Inertia(3.461245, (0, 0.034913, 0.123108), (0.02172, 0.02073, 0.007701, 0, 0, -0.003845)),
    Inertia(4.122995, (0, -0.039793, 0.086944), (0.03241, 0.030758, 0.009883, 0, 0, -0.006022)),
    Inertia(1.563756, (0, -0.029824, 0.076267), (0.008677, 0.007297, 0.003935, 0, 0, 0.002869)),
    Inertia(2.457878, (0, 0.07102, 0.00495), (0.007227, 0.006958, 0.004734, 0, 0, 0.000318)),
    Inertia(0.265331, (0, 0, 0.013782), (0.000175, 0.000175, 0.000306, 0, 0, 0)),
)
"""Another published set, in the frames of the second description: the ready-made model mismatch."""

INERTIA_SETS = ("nominal", "alternative")


def joint_index(name: str) -> int:
    """Position of a joint in the arm, counted from zero.

    Raises
    ------
    SettingsError
        If there is no such joint; the message lists the names that exist.
    """
    try:
        return JOINT_NAMES.index(name)
    except ValueError:
        raise SettingsError(f"joint '{name}' is unknown; the arm's joints are {', '.join(JOINT_NAMES)}") from None
