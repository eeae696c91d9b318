"""Whether the flange can reach the goal that a user drags."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.inverse_kinematics import is_attainable
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arm.workspace import unreachable
from contact_reach_ros.arrays import Array


class Reach(NamedTuple):
    """Whether some posture has the flange at a goal, with an explanation."""

    reachable: bool
    text: str


def reach(arm: Arm, position: Array, q: Array) -> Reach:
    """Search for a posture with the flange at `position` (3,), m; `q` (n,), rad, is the present one.

    By the planner's rule, except for rigid bodies. Other obstacles do not count: the arm may touch them.
    """
    refused = unreachable(arm, position)
    if refused:
        return Reach(False, f"will be refused: the position {refused}")
    rotations, origins = link_frames(arm, q)
    away = float(np.linalg.norm(position - origins[-1]))
    if is_attainable(arm, position, rotations[-1], q):
        return Reach(True, f"reachable, {away:.2f} m away")
    if is_attainable(arm, position, None, q):
        return Reach(False, f"{away:.2f} m away, reachable only with `goal_orientation: free`, not in this orientation")
    return Reach(False, "will be refused: the joint limits are in the way")
