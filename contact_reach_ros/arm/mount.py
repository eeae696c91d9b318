"""How an arm is mounted: gravity in its base frame, and the frame in which scenes and its home posture stand."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import STANDING, Arm, Array, Vector3
from contact_reach_ros.arm.kinematics import vector
from contact_reach_ros.arm.rotations import quaternion_from_rotation, rotation_from_quaternion

_DIGITS = 12
"""Decimals of gravity: an arm that only turns about the vertical has the same digest on every machine."""
_TILT = math.radians(60.0)
"""Angle between base and vertical from which on an arm does not stand."""
_HEIGHT = 0.5
"""Greatest height of the shoulder over what a scene stands on, as a share of the reach."""


def gravity_of(base: Array, gravity: ArrayLike = STANDING) -> Vector3:
    """Gravity (3,), m/s², in the axes of a base with the rotation `base` (3, 3) in a world that has `gravity` (3,)."""
    return vector(np.round(base.T @ np.asarray(gravity), _DIGITS) + 0.0)


def mounted(angles: Vector3) -> Vector3:
    """Gravity, m/s², in the axes of a base that is turned by roll, pitch and yaw, rad, as URDFs write rotations."""
    return gravity_of(pin.rpy.rpyToMatrix(*angles))


def tilt(arm: Arm) -> float:
    """Angle of the base's z axis from the vertical, rad: 0 for an arm that stands, π for one that hangs."""
    return math.acos(min(max(float(_up(arm)[2]), -1.0), 1.0))


def stands(arm: Arm) -> bool:
    """Whether the arm stands on its base, or on a slope, and neither hangs nor reaches out of a wall."""
    return tilt(arm) < _TILT


def in_words(arm: Arm) -> str:
    """Gravity that the arm's models assume."""
    strength = math.hypot(*arm.gravity)
    if tilt(arm) == 0.0:
        return f"gravity {strength:g} m/s² along -z of {arm.base_frame}"
    components = ", ".join(f"{value:.3g}" for value in arm.gravity)
    return f"gravity ({components}) m/s² in {arm.base_frame}, whose z axis is {math.degrees(tilt(arm)):.1f}° from up"


class SceneFrame(NamedTuple):
    """A frame with z up, x to the front and its origin below the shoulder, in the base frame."""

    rotation: Array
    """(3, 3)."""
    origin: Array
    """(3,), m."""

    def outward(self, points: Array) -> Array:
        """Points (..., 3), m, of this frame in the base frame."""
        return points @ self.rotation.T + self.origin

    def inward(self, points: Array) -> Array:
        """Points (..., 3), m, of the base frame in this one."""
        return (points - self.origin) @ self.rotation


def scene_frame(arm: Arm) -> SceneFrame:
    """Where scenes of an arm stand, and what is up and in front of it.

    An arm that stands on its base frame has that frame, unless the shoulder is higher over it than half the reach, as
    over the foot of a torso. Otherwise, and for an arm on a wall or ceiling, it is half the reach below the shoulder.
    In front is where the base's x axis points, or its z axis on a wall.
    """
    up, shoulder = _up(arm), np.array(arm.shoulder)
    ahead = np.eye(3)[2 if abs(up[2]) < math.cos(_TILT) else 0]
    x = ahead - (ahead @ up) * up
    x = x / np.linalg.norm(x)
    height, most = float(shoulder @ up), _HEIGHT * arm.reach
    below = min(height, most) if stands(arm) and height >= 0.0 else most
    return SceneFrame(np.column_stack([x, np.cross(up, x), up]), shoulder - below * up)


@functools.cache
def standing(arm: Arm) -> Arm:
    """The arm with its scene frame for a base frame: it moves as before, and gravity is along -z.

    It is the same object where the two frames are one.
    """
    frame = scene_frame(arm)
    if not frame.origin.any() and (frame.rotation == np.eye(3)).all():
        return arm

    def inward(point: Vector3) -> Vector3:
        return vector(frame.inward(np.array(point)))

    first = arm.joints[0]
    rotation = quaternion_from_rotation(frame.rotation.T @ rotation_from_quaternion(first.rotation))
    placed = dataclasses.replace(first, offset=inward(first.offset), rotation=rotation)
    fixed = (dataclasses.replace(each, start=inward(each.start), end=inward(each.end)) for each in arm.base_capsules)
    return dataclasses.replace(
        arm,
        joints=(placed, *arm.joints[1:]),
        base_capsules=tuple(fixed),
        shoulder=inward(arm.shoulder),
        gravity=(0.0, 0.0, -math.hypot(*arm.gravity)),
        bare=None,
    )


def _up(arm: Arm) -> Array:
    """Unit vector (3,) against gravity, base frame."""
    up: Array = -np.array(arm.gravity) / math.hypot(*arm.gravity)
    return up + 0.0
