"""From a commanded pose to a goal: what is refused, and why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from contact_reach_ros.errors import InputError
from contact_reach_ros.planning.problem import Goal
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.workspace import unreachable

Array = NDArray[np.float64]

ORIENTATIONS = ("hold", "pose", "free")
"""What becomes of the orientation: held as it is, taken from the message, or left free."""


def make_goal(frame: str, position: Array, quaternion: Array, orientation: str, present_rotation: Array) -> Goal:
    """Check a commanded flange pose and make the goal of it.

    Parameters
    ----------
    frame
        Frame that the pose is given in; must be the base frame.
    position
        (3,), m.
    quaternion
        (4,), x y z w; only looked at when `orientation` is 'pose'.
    orientation
        One of `ORIENTATIONS`.
    present_rotation
        (3, 3), what 'hold' holds.

    Raises
    ------
    InputError
        If a value is not finite, the frame is unknown, or the position is out of reach or inside the base; the field
        and what is expected are named.
    """
    if frame != iiwa14.BASE_NAME:
        raise InputError(f"goal_pose: header.frame_id is '{frame}'; expected '{iiwa14.BASE_NAME}'")
    if not np.isfinite(position).all():
        raise InputError(f"goal_pose: pose.position = {position.tolist()}; expected finite numbers in m")
    reason = unreachable(position)
    if reason:
        raise InputError(f"goal_pose: pose.position {reason}")
    if orientation == "free":
        return Goal(position)
    if orientation == "hold":
        return Goal(position, present_rotation)
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(length) and abs(length - 1.0) < 0.01):
        raise InputError(f"goal_pose: pose.orientation = {quaternion.tolist()}; expected a unit quaternion")
    return Goal(position, Rotation.from_quat(quaternion / length).as_matrix())
