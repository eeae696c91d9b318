"""Rotations as matrices and quaternions. Rotations by angles and vectors come from Pinocchio: `pin.rpy`, `pin.exp3`."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Array, Quaternion

_AT_ONCE = 1e-12
"""Angle between an axis and -z that is a rounding error, rad."""


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z), which need not be normalised."""
    w, x, y, z = np.asarray(quaternion, dtype=float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Array) -> Quaternion:
    """Unit quaternion (w, x, y, z) of a rotation matrix (3, 3), with w ≥ 0."""
    # Of a matrix stored row by row Pinocchio's bindings make a copy and never free it.
    found = pin.Quaternion(np.asfortranarray(rotation)).coeffs()
    x, y, z, w = (found if found[3] >= 0.0 else -found).tolist()
    return w, x, y, z


def frame_about(axis: Array) -> Array:
    """The smallest rotation (3, 3) that turns z into the direction of `axis` (3,); exact for ±x, ±y and ±z."""
    x, y, z = axis / np.linalg.norm(axis)
    across = x * x + y * y
    if z < 0.0 and across < _AT_ONCE**2:
        return np.diag([1.0, -1.0, -1.0])
    # The same for both; the one for z < 0 does not lose digits near -1.
    share = 1.0 / (1.0 + z) if z >= 0.0 else (1.0 - z) / across
    return np.array([[1.0 - share * x * x, -share * x * y, x], [-share * x * y, 1.0 - share * y * y, y], [-x, -y, z]])
