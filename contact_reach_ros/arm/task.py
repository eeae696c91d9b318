"""Tasks: how much of the tip's pose is controlled, and how much of it the joints of an arm can hold."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import link_frames_of_many
from contact_reach_ros.errors import SettingsError

POSE, AXIS, POSITION = "pose", "position_and_axis", "position"
TASK_ROWS = {POSE: 6, AXIS: 5, POSITION: 3}
"""Rows of each task: translation and rotation, translation and the direction of the tip's z axis, or translation."""

_POSTURES = 200
_LEAST_QUALITY = 0.02
"""Smallest singular value, with lengths in units of the reach, from which a Jacobian has full rank."""


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
