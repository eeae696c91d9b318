"""Which flange poses the arm can take, and the postures that hold them, for many seeds at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Arm, Array
from contact_reach_ros.arm.kinematics import AXIS, POSE, POSITION, link_frames_of_many, task_jacobians

_STEPS = 60
_DAMPING = 0.05
"""Damping of the least squares, m: below this singular value motions are held back."""
_LONGEST_STEP = 0.5
"""Longest step of a joint in one iteration, rad."""
EXACT = 1e-4, 1e-3
"""Distance, m, and angle, rad, from the pose within which a posture is at it."""


def solve_ik(
    arm: Arm,
    position: Array,
    rotation: Array | None,
    seeds: Array,
    margin: float,
    only_axis: bool = False,
    first: bool = False,
    tolerance: tuple[float, float] = EXACT,
) -> Array:
    """Find postures (N', n), rad, with the flange at a pose by damped least squares.

    Each seed leads to one posture or to none.

    Parameters
    ----------
    position, rotation
        Flange pose, (3,) m and (3, 3), base frame; None leaves the orientation free.
    seeds
        (N, n) starting points of the iterations, rad.
    margin
        Distance that the joints keep from their limits, rad.
    only_axis
        Find only the direction of the flange's z axis.
    first
        Return as soon as there is one.
    tolerance
        Distance, m, and angle, rad, from the pose up to which a posture is at it: joints' limits may keep the arm
        from more.
    """
    lower, upper = arm.lower + margin, arm.upper - margin
    q = np.clip(seeds, lower, upper)
    for _ in range(_STEPS):
        error, jacobian = pose_errors(arm, position, rotation, q, only_axis)
        if first and _is_there(error, tolerance).any():
            break
        gram = jacobian @ jacobian.transpose(0, 2, 1)
        # Damped in proportion to the error, so that the last steps are Newton's.
        size = np.minimum(np.linalg.norm(error, axis=1), 1.0)
        gram += (_DAMPING**2 * size)[:, None, None] * np.eye(error.shape[1]) + 1e-9 * np.eye(error.shape[1])
        step = np.einsum("nij,ni->nj", jacobian, np.linalg.solve(gram, error[:, :, None])[:, :, 0])
        q = np.clip(q - np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), lower, upper)
    error, _ = pose_errors(arm, position, rotation, q, only_axis)
    return q[_is_there(error, tolerance)]


def _is_there(error: Array, tolerance: tuple[float, float]) -> Array:
    """Which of the pose errors (N, 6), (N, 5) or (N, 3) are small enough, (N,)."""
    found: Array = np.linalg.norm(error[:, :3], axis=1) < tolerance[0]
    return found & (np.linalg.norm(error[:, 3:], axis=1) < tolerance[1])


def pose_errors(
    arm: Arm, position: Array, rotation: Array | None, q: Array, only_axis: bool = False
) -> tuple[Array, Array]:
    """Pose errors (N, m), m and rad, and Jacobians (N, m, n) in postures (N, n), as for `solve_ik`.

    The rows are those of `task_jacobians`: 6 of a pose, 5 of position and axis, 3 where the orientation is free.
    """
    frames, origins = link_frames_of_many(arm, q)
    task = POSITION if rotation is None else AXIS if only_axis else POSE
    offset, jacobians = origins[-1].T - position, task_jacobians(frames, origins, task)
    if rotation is None:
        return offset, jacobians
    if only_axis:
        x, y, z = frames[-1].transpose(0, 2, 1)
        across = np.stack([x, y], axis=1)
        turn = np.cross(rotation[:, 2], z)
        sine, cosine = np.linalg.norm(turn, axis=1), z @ rotation[:, 2]
        turn *= (np.arctan2(sine, cosine) / np.maximum(sine, 1e-9))[:, None]
        turn = np.einsum("nik,nk->ni", across, turn)
    else:
        turn = np.array([pin.log3(each) for each in frames[-1].transpose(2, 1, 0) @ rotation.T]).reshape(-1, 3)
    return np.concatenate([offset, turn], axis=1), jacobians
