"""Kinematics straight from an arm's table (numpy, without a model), and the tasks that its joints can hold."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm, Array, Vector3
from contact_reach_ros.arm.rotations import rotation_from_quaternion
from contact_reach_ros.errors import SettingsError

POSE, AXIS, POSITION = "pose", "position_and_axis", "position"
TASK_ROWS = {POSE: 6, AXIS: 5, POSITION: 3}
"""Rows of each task: translation and rotation, translation and the direction of the tip's z axis, or translation."""

_POSTURES = 200
_LEAST_QUALITY = 0.02
"""Smallest singular value, with lengths in units of the reach, from which a Jacobian has full rank."""
_MANY = 10_000
"""Postures at once."""


@functools.cache
def _frames_at_zero(arm: Arm) -> tuple[Array, Array]:
    """Offsets (n + 1, 3) and rotations (n + 1, 3, 3) of links at angle zero and tip, relative to the one before."""
    offsets = np.array([*(joint.offset for joint in arm.joints), arm.tip_offset])
    rotations = (*(joint.rotation for joint in arm.joints), arm.tip_rotation)
    return offsets, np.array([rotation_from_quaternion(rotation) for rotation in rotations])


def link_frames(arm: Arm, q: ArrayLike) -> tuple[list[Array], list[Array]]:
    """Rotations (3, 3) and origins (3,) of the n link frames, then the tip, in the base frame, at `q` (n,), rad."""
    offsets, at_zero = _frames_at_zero(arm)
    # The tip does not turn.
    angles = np.append(np.asarray(q, dtype=float), 0.0)
    turns = np.zeros((arm.n + 1, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turns[:, 2, 2] = 1.0
    rotation, origin = np.eye(3), np.zeros(3)
    rotations, origins = [], []
    for offset, step in zip(offsets, at_zero @ turns, strict=True):
        origin = origin + rotation @ offset
        rotation = rotation @ step
        rotations.append(rotation)
        origins.append(origin)
    return rotations, origins


def link_frames_of_many(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Link frames as `link_frames` gives them for postures `q` (N, n), with the posture last.

    Returns the axes (n + 1, 3, 3, N) of the frames, indexed [frame, axis, coordinate], and the origins (n + 1, 3, N).
    """
    offsets, at_zero = _frames_at_zero(arm)
    cosine, sine = np.cos(q.T), np.sin(q.T)
    axes, origins = np.empty((arm.n + 1, 3, 3, len(q))), np.empty((arm.n + 1, 3, len(q)))
    frame, origin = np.repeat(np.eye(3)[:, :, None], len(q), axis=2), np.zeros((3, len(q)))
    for joint, (offset, step) in enumerate(zip(offsets[:-1], at_zero[:-1], strict=True)):
        flat = frame.reshape(3, -1)
        origin = origins[joint] = origin + (offset @ flat).reshape(3, -1)
        x, y, z = (step.T @ flat).reshape(3, 3, -1)
        frame = axes[joint]
        frame[0] = cosine[joint] * x + sine[joint] * y
        frame[1] = cosine[joint] * y - sine[joint] * x
        frame[2] = z
    axes[-1] = (at_zero[-1].T @ frame.reshape(3, -1)).reshape(3, 3, -1)
    origins[-1] = origin + (offsets[-1] @ frame.reshape(3, -1)).reshape(3, -1)
    return axes, origins


def tip_positions(arm: Arm, q: Array) -> Array:
    """Positions (N, 3) of the tip, m, base frame, for postures `q` (N, n), rad."""
    # Frames take 100 numbers a posture, and an hour's recording has many.
    parts = (q[first : first + _MANY] for first in range(0, max(len(q), 1), _MANY))
    return np.concatenate([link_frames_of_many(arm, part)[1][-1].T for part in parts])


def task_jacobians(axes: Array, origins: Array, task: str) -> Array:
    """Jacobians (N, m, n) of the m rows of a task, out of frames as `link_frames_of_many` gives them.

    The first three rows are in the base frame, as are the last three of a pose; the last two of the z axis are about
    the tip's x and y axes.
    """
    turns = axes[:-1, 2]
    linear = np.cross(turns, origins[-1] - origins[:-1], axis=1).transpose(2, 1, 0)
    if task == POSITION:
        return linear
    angular = turns.transpose(2, 1, 0)
    if task == AXIS:
        angular = axes[-1, :2].transpose(2, 0, 1) @ angular
    return np.concatenate([linear, angular], axis=1)


def greatest_task(arm: Arm) -> str:
    """The task with most rows that the joints can hold: in some posture they move the tip in all of its directions.

    Raises `SettingsError` if they cannot even move it in the three directions of a position.
    """
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_POSTURES, arm.n))
    axes, origins = link_frames_of_many(arm, q)
    directions = 0
    for task, rows in TASK_ROWS.items():
        values = np.linalg.svd(task_jacobians(axes, origins / arm.reach, task), compute_uv=False)
        directions = int((values > _LEAST_QUALITY).sum(axis=1).max())
        if directions == rows:
            return task
    raise SettingsError(
        f"the {arm.n} joints of arm '{arm.name}' move its tip in {directions} directions; expected at least the 3 rows "
        f"of impedance.task = {POSITION}: free joints that are held under fixed, or choose another base or tip"
    )


def tensor_matrix(tensor: tuple[float, ...]) -> Array:
    """Symmetric matrix (3, 3) of an inertia given as (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = tensor
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def tensor_values(matrix: Array) -> tuple[float, float, float, float, float, float]:
    """An inertia (3, 3) as (xx, yy, zz, xy, xz, yz)."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrix.tolist()
    return xx, yy, zz, xy, xz, yz


def vector(values: ArrayLike) -> Vector3:
    """Three numbers as a tuple."""
    x, y, z = np.asarray(values, dtype=float).tolist()
    return x, y, z
