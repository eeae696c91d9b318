"""The arm's capsules as segments, their distances, and the pairs of them that can touch each other."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm, Array, Capsule
from contact_reach_ros.arm.kinematics import link_frames_of_many

_POSTURES = 8192
"""Random postures within the limits that decide which capsules can touch."""
_NEAR = 0.01
"""Capsules that were never nearer to each other than this, m, cannot touch."""
_TURNED = 100
"""Of these, those in which joints turn one by one."""
_POINT = 1e-12
"""Squared length of a segment that is a point, m²."""
_UNCHANGED = 1e-3
"""Changes of a distance, m, below which a joint does not change it."""


def shapes(arm: Arm) -> tuple[Capsule, ...]:
    """All collision shapes: those that do not move, then those of the moving links."""
    return (*arm.base_capsules, *arm.capsules)


def moving(arm: Arm) -> slice:
    """Those of `shapes` that are on moving links."""
    return slice(len(arm.base_capsules), None)


def shape_name(arm: Arm, shape: int) -> str:
    """Name of the link that carries one of `shapes`."""
    capsule = shapes(arm)[shape]
    return capsule.name or (arm.link_names[capsule.link - 1] if capsule.link else arm.base_frame)


@functools.cache
def shape_radii(arm: Arm) -> Array:
    """Radii (S,) of `shapes`, m."""
    return np.array([shape.radius for shape in shapes(arm)])


def shape_segments(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Start and end points of `shapes` in the postures `q` (N, n), rad: (N, S, 3) each, m, base frame."""
    axes, origins = link_frames_of_many(arm, q)
    # The base first; of the frames, the tip's last.
    frames = np.concatenate([np.broadcast_to(np.eye(3)[None, :, :, None], (1, 3, 3, len(q))), axes])
    origins = np.concatenate([np.zeros((1, 3, len(q))), origins])
    links = [shape.link for shape in shapes(arm)]

    def placed(points: Array) -> Array:
        return (np.einsum("sa,sacn->nsc", points, frames[links]) + origins[links].transpose(2, 0, 1)).copy()

    starts, ends = np.array([shape.start for shape in shapes(arm)]), np.array([shape.end for shape in shapes(arm)])
    return placed(starts.astype(float)), placed(ends.astype(float))


def volume(start: Array, end: Array, radius: float) -> float:
    """Of a capsule, m³."""
    return math.pi * radius**2 * (float(np.linalg.norm(end - start)) + 4.0 / 3.0 * radius)


def segment_distances(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Distance (...) of segments from `start` to `end`, (..., 3) each, m.

    The nearest points of two lines, put back into the segments one after the other (Ericson, Real-Time Collision
    Detection, 2005, 5.1.9).
    """
    (start, end), (other_start, other_end) = first, second
    along, across, between = end - start, other_end - other_start, start - other_start
    a, e = (np.maximum((vector**2).sum(axis=-1), _POINT) for vector in (along, across))
    b, c, f = (along * across).sum(axis=-1), (along * between).sum(axis=-1), (across * between).sum(axis=-1)
    share = np.clip((b * f - c * e) / np.maximum(a * e - b * b, 1e-12), 0.0, 1.0)
    other = np.clip((b * share + f) / e, 0.0, 1.0)
    share = np.clip((b * other - c) / a, 0.0, 1.0)
    return np.linalg.norm(between + share[..., None] * along - other[..., None] * across, axis=-1)


@functools.cache
def self_pairs(arm: Arm, overlapping: bool = False) -> tuple[tuple[int, int], ...]:
    """Indices into `shapes` of the pairs that are kept apart: those of `touching_pairs` that are apart at home.

    If `overlapping`, those that nothing keeps apart instead, though they can touch.
    """
    pairs = touching_pairs(arm)
    overlap = pair_distances(arm, np.array([arm.home]), pairs)[0] < 0.0
    return tuple((int(first), int(second)) for first, second in pairs[overlap == overlapping])


@functools.cache
def touching_pairs(arm: Arm) -> NDArray[np.intp]:
    """Indices (P, 2) into `shapes` of the pairs that can touch.

    Left out are pairs that no posture within the limits brings near each other, and those whose distance a single
    joint changes: that joint's limits keep them apart, whatever the capsules' coarse ends do.
    """
    random = np.random.default_rng(0)
    postures = random.uniform(arm.lower, arm.upper, (_POSTURES, arm.n))
    pairs = np.stack(np.triu_indices(len(shapes(arm)), 1), axis=1)
    # One of each pair moves.
    pairs = pairs[pairs[:, 1] >= len(arm.base_capsules)]
    pairs = pairs[pair_distances(arm, postures, pairs).min(axis=0) < _NEAR]
    few = postures[:_TURNED]
    before, changing = pair_distances(arm, few, pairs), np.zeros(len(pairs), int)
    for joint in range(arm.n):
        turned = few.copy()
        turned[:, joint] = random.uniform(arm.lower[joint], arm.upper[joint], len(few))
        changing += np.abs(pair_distances(arm, turned, pairs) - before).max(axis=0) > _UNCHANGED
    return pairs[changing > 1]


def pair_distances(arm: Arm, q: Array, pairs: NDArray[np.intp]) -> Array:
    """Distances (N, P) of the surfaces of pairs (P, 2) of `shapes` in postures (N, n), m."""
    return pairs_apart(arm, shape_segments(arm, q), pairs)


def pairs_apart(arm: Arm, segments: tuple[Array, Array], pairs: NDArray[np.intp]) -> Array:
    """The same for start and end points of `shapes`, (N, S, 3) each, m."""
    (first, second), (starts, ends) = pairs.T, segments
    apart = segment_distances((starts[:, first], ends[:, first]), (starts[:, second], ends[:, second]))
    return apart - (shape_radii(arm)[first] + shape_radii(arm)[second])
