"""How deep obstacle spheres lie in the arm's capsules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames, rotation_about

Array = NDArray[np.float64]

MIDDLE_LINKS = (3, 4, 5)
HAND_LINKS = (6, 7)

RADII = np.array([capsule.radius for capsule in iiwa14.CAPSULES])
LINKS = np.array([capsule.link for capsule in iiwa14.CAPSULES])

_HAND = np.isin(LINKS, HAND_LINKS)


def capsule_segments(q: Array) -> tuple[Array, Array]:
    """Start and end points of the arm's capsules in the base frame, (6, 3) each, m."""
    rotations, origins = link_frames(q)
    starts, ends = [], []
    for capsule in iiwa14.CAPSULES:
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        starts.append(origin + rotation @ capsule.start)
        ends.append(origin + rotation @ capsule.end)
    return np.array(starts), np.array(ends)


def path_segments(path: Array) -> tuple[Array, Array]:
    """The same along a path (N, 7): (N, 6, 3) each."""
    pairs = [capsule_segments(q) for q in path]
    return np.array([starts for starts, _ in pairs]), np.array([ends for _, ends in pairs])


def swivelled_segments(q: Array, angles: Array) -> tuple[Array, Array]:
    """The capsules in the postures that hold the flange pose of `q` (7,), (A, 6, 3) each.

    Upper arm and forearm turn by `angles` (A,), rad, about the line from shoulder to wrist, where the axes of A5 to A7
    meet; the hand stays. A full turn covers every such posture, whether or not the joints can reach it.
    """
    starts, ends = capsule_segments(q)
    _, origins = link_frames(q)
    shoulder = np.array(iiwa14.SHOULDER_POSITION)
    axis = origins[5] - shoulder
    axis /= np.linalg.norm(axis)
    turns = np.array([rotation_about(axis, angle) for angle in angles])

    def turned(points: Array) -> Array:
        return np.where(_HAND[:, None], points, shoulder + np.einsum("aij,cj->aci", turns, points - shoulder))

    return turned(starts), turned(ends)


def overlap_depths(starts: Array, ends: Array, centers: Array, radius: float) -> Array:
    """How deep each sphere lies in each capsule, (..., 6, P), m; negative values are distances.

    `starts` and `ends` are (..., 6, 3), `centers` (P, 3).
    """
    axis = (ends - starts)[..., None, :]
    offset = centers - starts[..., None, :]
    share = np.clip(np.sum(offset * axis, axis=-1) / np.sum(axis * axis, axis=-1), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * axis, axis=-1)
    return RADII[:, None] + radius - distance


def base_distances(points: Array) -> Array:
    """Distances of points (..., 3) from the surface of the base, (...), m; negative inside."""
    capsule = iiwa14.BASE_CAPSULE
    offset = points - np.array(capsule.start)
    offset[..., 2] = points[..., 2] - np.clip(points[..., 2], capsule.start[2], capsule.end[2])
    return np.linalg.norm(offset, axis=-1) - capsule.radius
