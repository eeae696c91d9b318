"""Goals that identify an arm: around its home pose, with turns of the wrist, one after the other."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.collision import clearances, nearest
from contact_reach_ros.world.spheres import Spheres

CLEARANCE = 0.1
"""Least distance of obstacles from the arm on its way, m."""

_GOALS = (
    ((0.00, 0.12, 0.05), (0.0, 0.0, 1.5)),
    ((0.05, -0.12, -0.05), (0.5, 0.0, -1.5)),
    ((-0.10, 0.10, 0.00), (-0.5, 0.0, 1.0)),
    ((0.05, 0.00, 0.10), (0.0, 0.7, -1.0)),
    ((0.00, -0.15, 0.00), (0.0, -0.5, 0.0)),
    ((-0.05, 0.15, 0.10), (0.5, 0.5, 1.5)),
    ((0.05, 0.00, -0.05), (-0.5, -0.5, -1.5)),
    ((-0.08, -0.12, 0.08), (0.0, 0.5, 1.0)),
    ((0.05, 0.12, 0.00), (0.3, -0.5, -1.0)),
    ((0.00, 0.00, 0.00), (0.0, 0.0, 0.0)),
)
"""Offsets from the home pose: m in the base frame, and rotations in that of the tip, rad."""
_STEPS = 20
"""Postures on the way between two goals at which the clearance is checked."""


def goals(arm: Arm) -> list[tuple[Array, Array]]:
    """Positions (3,), m, and rotations (3, 3) of the tip in the base frame."""
    rotations, origins = link_frames(arm, arm.home)
    return [(origins[-1] + offset, rotations[-1] @ Rotation.from_rotvec(turn).as_matrix()) for offset, turn in _GOALS]


def check_clearance(arm: Arm, q: Array, obstacles: Spheres, margin: float = CLEARANCE) -> None:
    """Check that the arm has room for the goals, on straight ways of the joints between them.

    Raises `InputError` if a goal cannot be reached, or something is nearer.

    Parameters
    ----------
    q
        Present posture (n,), rad.
    obstacles
        What stands around.
    margin
        Room that it needs, m.
    """
    before = q
    for number, (position, rotation) in enumerate(goals(arm), 1):
        postures = solve_ik(arm, position, rotation, np.stack([before, np.array(arm.home)]), 0.05)
        if not len(postures):
            raise InputError(f"goal {number} of the motion is out of this arm's reach: give a bag instead (--bag)")
        between = before + np.linspace(0.0, 1.0, _STEPS)[:, None] * (postures[0] - before)
        gap = min(float(clearances(arm, each, obstacles).min()) for each in between) if len(obstacles) else margin
        if gap < margin:
            raise InputError(
                f"an obstacle would be {gap:.2f} m from the arm on the way to goal {number}; the motion needs "
                f"{margin:g} m: clear the space, or give a bag of another motion (--bag)"
            )
        worst = min(nearest(arm, between, obstacles.environment), default=None)
        if worst is not None and worst.distance < 0.0:
            raise InputError(f"on the way to goal {number} {worst}; give a bag of another motion (--bag)")
        before = postures[0]
