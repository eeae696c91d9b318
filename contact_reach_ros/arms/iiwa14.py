"""The KUKA LBR iiwa 14 R820 as one table: kinematics, limits, inertial parameters, capsules and thresholds.

Link frames rotate with their joint, whose axis is the local z. Units are SI: m, kg, rad, N m, s.
"""

from __future__ import annotations

import math

from contact_reach_ros.arm import Arm, Capsule, Inertia, Joint, Quaternion, Vector3

_ARMATURE = 0.01
"""Reflected motor inertia of every joint, kg m²: link 7 alone (0.001 kg m²) would be unphysically light."""


def _joint(
    number: int, offset: Vector3, rotation: Quaternion, limit_deg: float, speed_deg: float, torque: float
) -> Joint:
    limit, speed = math.radians(limit_deg), math.radians(speed_deg)
    return Joint(f"lbr_A{number}", offset, rotation, -limit, limit, speed, torque, _ARMATURE)


_NO_PRODUCTS = (0.0, 0.0, 0.0)

_NOMINAL_INERTIAS = (
    Inertia(5.76, (0, -0.03, 0.12), (0.0333, 0.033, 0.0123, *_NO_PRODUCTS)),
    Inertia(6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011, *_NO_PRODUCTS)),
    Inertia(3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076, *_NO_PRODUCTS)),
    Inertia(3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006, *_NO_PRODUCTS)),
    Inertia(3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449, *_NO_PRODUCTS)),
    Inertia(1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036, *_NO_PRODUCTS)),
    Inertia(1.2, (0, 0, 0.02), (0.001, 0.001, 0.001, *_NO_PRODUCTS)),
)
"""The common simulation set, in the link frames of `ARM`."""

_ALTERNATIVE_INERTIAS = (
    Inertia(5.289529, (0.0, -0.033795, 0.122404), (0.042462, 0.042838, 0.01587, 0.0, 0.0, 0.006341)),
    Inertia(5.688888, (-0.000136, 0.076322, 0.037548), (0.055182, 0.016523, 0.053983, 0.0, 0.0, 0.010034)),
    Inertia(3.461245, (0.0, 0.034913, 0.146608), (0.02172, 0.02073, 0.007701, 0.0, 0.0, -0.003845)),
    Inertia(4.122995, (0.0, 0.086944, 0.029293), (0.03241, 0.009883, 0.030758, 0.0, 0.0, 0.006022)),
    Inertia(1.563756, (0.0, 0.029824, 0.099267), (0.008677, 0.007297, 0.003935, 0.0, 0.0, -0.002869)),
    Inertia(2.457878, (0.0, 0.00495, 0.00032), (0.007227, 0.004734, 0.006958, 0.0, 0.0, 0.000318)),
    Inertia(0.265331, (0.0, 0.0, 0.023782), (0.000175, 0.000175, 0.000306, 0.0, 0.0, 0.0)),
)
"""Another published set, moved from frames parallel to the base at angle zero into those of `ARM`: a ready-made model
mismatch."""

ARM = Arm(
    name="iiwa14",
    joints=(
        _joint(1, (0, 0, 0.1575), (1, 0, 0, 0), 170, 85, 320),
        _joint(2, (0, 0, 0.2025), (0, 0, 1, 1), 120, 85, 320),
        _joint(3, (0, 0.2045, 0), (0, 0, 1, 1), 170, 100, 176),
        _joint(4, (0, 0, 0.2155), (1, 1, 0, 0), 120, 75, 176),
        _joint(5, (0, 0.1845, 0), (0, 0, 1, 1), 170, 130, 110),
        _joint(6, (0, 0, 0.2155), (1, 1, 0, 0), 120, 135, 40),
        _joint(7, (0, 0.081, 0), (0, 0, 1, 1), 175, 135, 40),
    ),
    link_names=tuple(f"lbr_link_{number}" for number in range(1, 8)),
    base_frame="lbr_link_0",
    tip_frame="lbr_link_ee",
    tip_offset=(0.0, 0.0, 0.045),
    capsules=(
        Capsule(2, (0, 0, 0), (0, 0.2045, 0), 0.095),
        Capsule(3, (0, 0, 0), (0, 0, 0.2155), 0.095),
        Capsule(4, (0, 0, 0), (0, 0.1845, 0), 0.08),
        Capsule(5, (0, 0, 0), (0, 0, 0.2155), 0.075),
        Capsule(6, (0, -0.01, 0), (0, 0.03, 0), 0.08),
        Capsule(7, (0, 0, -0.01), (0, 0, 0.03), 0.06),
    ),
    # The base and the first link, which only turns about its own axis.
    base_capsule=Capsule(0, (0, 0, 0.05), (0, 0, 0.30), 0.11),
    inertia_sets={"nominal": _NOMINAL_INERTIAS, "alternative": _ALTERNATIVE_INERTIAS},
    shoulder=(0.0, 0.0, 0.36),
    reach=0.85,
    home=(0.0, math.radians(45), 0.0, math.radians(-90), 0.0, math.radians(45), 0.0),
    defaults={
        "torque_thresholds": (30.0, 30.0, 25.0, 25.0, 15.0, 10.0, 8.0),
        "torque_per_speed": (2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0),
        "sudden_thresholds": (12.0, 12.0, 9.0, 9.0, 5.0, 5.0, 4.0),
        "contact_thresholds": (2.5, 2.5, 2.0, 2.0, 1.4, 1.4, 1.4),
        "contact_per_speed": (1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5),
        "handover_thresholds": (8.0, 10.0, 6.0, 6.0, 3.0, 3.0, 3.0),
    },
)
"""The iiwa 14 R820."""
