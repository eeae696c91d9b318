"""Targets of the flange, and checks of commanded poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.workspace import unreachable
from contact_reach_ros.arrays import Array, checked_array
from contact_reach_ros.errors import InputError

_SAME_POSITION, _SAME_ROTATION = 1e-3, 1e-2
"""Differences up to which two targets are the same, m and rad."""


@dataclass(frozen=True)
class Target:
    """Pose that the flange has to reach, in the base frame.

    Raises
    ------
    InputError
        If a value is not finite, has the wrong shape, or the rotation is not a rotation matrix.
    """

    position: Array
    """(3,), m."""
    rotation: Array | None = None
    """(3, 3), or None to leave the orientation free."""
    only_axis: bool = False
    """Whether only the direction of its z axis counts, about which the flange may be turned as it likes."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checked_array("goal position", self.position, (3,)))
        if self.rotation is not None:
            rotation = checked_array("goal rotation", self.rotation, (3, 3))
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
                raise InputError(
                    "goal rotation: expected an orthonormal, right-handed matrix; normalise its quaternion"
                )
            object.__setattr__(self, "rotation", rotation)

    def angle(self, rotation: Array) -> float:
        """Angle from an orientation (3, 3) to the target's, or between the z axes, rad; 0 where any will do."""
        if self.rotation is None:
            return 0.0
        # ‖R - R'‖ / √2 is 2 sin(angle / 2), and so is ‖z - z'‖.
        error, most = (self.rotation - rotation)[:, 2 if self.only_axis else slice(None)], 2.0 * math.sqrt(2.0)
        return 2.0 * math.asin(min(1.0, float(np.linalg.norm(error)) / (2.0 if self.only_axis else most)))

    def same_as(self, other: Target | None) -> bool:
        """Whether both ask for the same pose, to 1 mm and 10 mrad, so that plans for one are a start for the other."""
        if other is None or (self.rotation is None) != (other.rotation is None) or self.only_axis != other.only_axis:
            return False
        turned = 0.0 if other.rotation is None else self.angle(other.rotation)
        return turned <= _SAME_ROTATION and math.dist(self.position, other.position) <= _SAME_POSITION


def make_goal(
    arm: Arm, frame: str, position: Array, quaternion: Array, orientation: str, present_rotation: Array
) -> Target:
    """Check a commanded flange pose and turn it into a target.

    Parameters
    ----------
    arm
        Arm whose flange it is.
    frame
        Frame of the pose; must be the base frame.
    position
        (3,), m.
    quaternion
        (4,), x y z w; used only when `orientation` is 'pose'.
    orientation
        One of `orientations.ORIENTATIONS`.
    present_rotation
        (3, 3), held by 'hold'.

    Raises
    ------
    InputError
        If a value is not finite, the frame is unknown, or the position is out of reach or inside the base; the message
        names the field and the expectation.
    """
    if frame != arm.base_frame:
        raise InputError(f"goal: frame '{frame}' is unknown; expected '{arm.base_frame}'")
    if not np.isfinite(position).all():
        raise InputError(f"goal: position = {position.tolist()}; expected finite numbers in m")
    reason = unreachable(arm, position)
    if reason:
        raise InputError(f"goal: position {reason}")
    if orientation == "free":
        return Target(position)
    if orientation == "hold":
        return Target(position, present_rotation)
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(length) and abs(length - 1.0) < 0.01):
        raise InputError(f"goal: orientation = {quaternion.tolist()}; expected a unit quaternion x, y, z, w")
    return Target(position, Rotation.from_quat(quaternion / length).as_matrix())
