"""Whether the flange can be brought to where a user drags the goal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.inverse_kinematics import solve_ik
from contact_reach_ros.planning.problem import Goal
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.robot.workspace import unreachable

Array = NDArray[np.float64]

_SEEDS = 6
_MARGIN = 0.05
"""To the joint limits, rad."""


class Reach(NamedTuple):
    """What is known of a goal.

    Attributes
    ----------
    reachable
        Whether some posture has the flange there.
    text
        The same in words.
    """

    reachable: bool
    text: str


def reach(position: Array, q: Array) -> Reach:
    """Whether a posture is found with the flange at `position` (3,), m; `q` (7,), rad, is the present one.

    The planner refuses only what is out of the arm's reach or inside its base; a posture may still be missing because
    of the joint limits. Obstacles are not looked at: the arm may touch them.
    """
    refused = unreachable(position)
    if refused:
        return Reach(False, f"will be refused: the position {refused}")
    generator = np.random.default_rng(0)
    limits = np.array(iiwa14.POSITION_LIMITS) - _MARGIN
    # The same seeds each time, so that the answer does not flicker while the goal stands still.
    seeds = np.concatenate([[q, iiwa14.HOME_POSITION], generator.uniform(-limits, limits, (_SEEDS, len(limits)))])
    rotations, origins = link_frames(q)
    away = float(np.linalg.norm(position - origins[-1]))
    if len(solve_ik(Goal(position, rotations[-1]), seeds, _MARGIN)):
        return Reach(True, f"reachable, {away:.2f} m away")
    if len(solve_ik(Goal(position), seeds, _MARGIN)):
        return Reach(True, f"reachable, {away:.2f} m away, but not with the flange turned as it is")
    return Reach(False, "no posture found: the joint limits are in the way")
