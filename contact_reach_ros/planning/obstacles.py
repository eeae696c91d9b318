"""From any number of spheres to the fixed number that a compiled program takes."""

from __future__ import annotations

import jax
import numpy as np

from contact_reach_ros.planning.problem import Array, Spheres
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames

_FAR_AWAY = (0.0, 0.0, -100.0)
"""Where the spheres that fill up the capacity are, m: out of reach, near enough for single precision."""


def clearances(q: Array, spheres: Spheres) -> Array:
    """Distance (K,) of each sphere's surface from the nearest link capsule at joint angles `q` (7,), m."""
    rotations, origins = link_frames(q)
    nearest = np.full(len(spheres), np.inf)
    for capsule in iiwa14.CAPSULES:
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        start = origin + rotation @ capsule.start
        axis = rotation @ np.subtract(capsule.end, capsule.start)
        share = np.clip((spheres.center - start) @ axis / (axis @ axis), 0.0, 1.0)
        gap = np.linalg.norm(spheres.center - start - share[:, None] * axis, axis=1)
        nearest = np.minimum(nearest, gap - capsule.radius)
    return nearest - spheres.radius


def fit_to_capacity(q: Array, spheres: Spheres, capacity: int) -> tuple[Obstacles | None, int]:
    """The spheres as the transfer model takes them, with one lane, and how many were left out.

    The spheres nearest to the arm at joint angles `q` (7,) are kept; far-away ones fill up the rest.
    """
    count = len(spheres)
    if capacity == 0:
        return None, count
    kept = np.arange(count)
    if count > capacity:
        # Sorted, so that a sphere keeps its place for as long as it is kept.
        kept = np.sort(np.argsort(clearances(q, spheres), kind="stable")[:capacity])
    missing = capacity - len(kept)
    far_away = np.tile(_FAR_AWAY, (missing, 1))

    def points(values: Array) -> jax.Array:
        return single(np.concatenate([values[kept], far_away]).T[:, :, None])

    def column(values: Array, filler: float) -> jax.Array:
        return single(np.concatenate([values[kept], np.full(missing, filler)])[:, None])

    obstacles = Obstacles(
        center=points(spheres.center),
        rest=points(spheres.rest),
        radius=column(spheres.radius, 0.0),
        stiffness=column(spheres.stiffness, 1.0),
        damping=column(spheres.damping, 1.0),
    )
    return obstacles, count - len(kept)
