"""Distances between obstacles and the arm."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.world.spheres import Spheres


def clearances(arm: Arm, q: Array, spheres: Spheres) -> Array:
    """Distance (K,) of each sphere's surface from the nearest link capsule at joint angles `q` (n,), m."""
    rotations, origins = link_frames(arm, q)
    nearest = np.full(len(spheres), np.inf)
    for capsule in arm.capsules:
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        start = origin + rotation @ capsule.start
        axis = rotation @ np.subtract(capsule.end, capsule.start)
        share = np.clip((spheres.center - start) @ axis / (axis @ axis), 0.0, 1.0)
        gap = np.linalg.norm(spheres.center - start - share[:, None] * axis, axis=1)
        nearest = np.minimum(nearest, gap - capsule.radius)
    return nearest - spheres.radius
