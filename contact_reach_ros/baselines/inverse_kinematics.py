"""Postures that hold the flange at a goal, for many seeds at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from contact_reach_ros.planning.problem import Goal
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames_of_many

Array = NDArray[np.float64]

_STEPS = 60
_DAMPING = 0.05
"""Of the damped least squares, m: below this singular value motions are held back."""
_LONGEST_STEP = 0.5
"""Of a joint in one iteration, rad."""
_POSITION_TOLERANCE, _ROTATION_TOLERANCE = 1e-4, 1e-3


def solve_ik(goal: Goal, seeds: Array, margin: float) -> Array:
    """Postures (N', 7), rad, with the flange at the goal, to 0.1 mm and 1 mrad: one for each seed that leads to one.

    Damped least squares; where the goal leaves the orientation free, the position alone.

    Parameters
    ----------
    goal
        Of the flange.
    seeds
        (N, 7) where the iterations start, rad.
    margin
        Distance that the joints keep from their limits, rad.
    """
    limits = np.array(iiwa14.POSITION_LIMITS) - margin
    q = np.clip(seeds, -limits, limits)
    for _ in range(_STEPS):
        error, jacobian = _errors(goal, q)
        gram = jacobian @ jacobian.transpose(0, 2, 1)
        # Damped in proportion to the error, so that the last steps are Newton's.
        size = np.minimum(np.linalg.norm(error, axis=1), 1.0)
        gram += (_DAMPING**2 * size)[:, None, None] * np.eye(error.shape[1]) + 1e-9 * np.eye(error.shape[1])
        step = np.einsum("nij,ni->nj", jacobian, np.linalg.solve(gram, error[:, :, None])[:, :, 0])
        q = np.clip(q - np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), -limits, limits)
    error, _ = _errors(goal, q)
    found = np.linalg.norm(error[:, :3], axis=1) < _POSITION_TOLERANCE
    found &= np.linalg.norm(error[:, 3:], axis=1) < _ROTATION_TOLERANCE
    return q[found]


def _errors(goal: Goal, q: Array) -> tuple[Array, Array]:
    """Pose errors (N, 6) and Jacobians (N, 6, 7), or the first three rows where the orientation is free."""
    frames, origins = link_frames_of_many(q)
    axes = frames[:7, 2]
    linear = np.cross(axes, origins[7] - origins[:7], axis=1).transpose(2, 1, 0)
    offset = origins[7].T - goal.position
    if goal.rotation is None:
        return offset, linear
    turn = Rotation.from_matrix(frames[7].transpose(2, 1, 0) @ goal.rotation.T).as_rotvec()
    return np.concatenate([offset, turn], axis=1), np.concatenate([linear, axes.transpose(2, 1, 0)], axis=1)
