"""How deep obstacle spheres lie in the arm's capsules."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.kinematics import link_frames, rotation_about
from contact_reach_ros.arrays import Array

_HAND_LINKS = 2
"""Number of links, counted from the tip, that make up the hand."""
_FIRST_MIDDLE_LINK = 3
_MEETING = 1e-6
"""Distance up to which axes meet, m."""
_SWIVELS = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
_SEEDS = 200
"""Random postures from which those with one tip pose are searched."""
_LIMIT_MARGIN = 0.1
"""Least distance of their joints from the limits, rad."""
_POINTS = np.linspace(0.0, 1.0, 21)
"""Where heights along a capsule are measured, as shares of its length."""


@functools.cache
def radii(arm: Arm) -> Array:
    """Radii (C,) of the capsules, m."""
    return np.array([capsule.radius for capsule in arm.capsules])


@functools.cache
def capsule_links(arm: Arm) -> NDArray[np.intp]:
    """Number of the link that each capsule is on, (C,), counted from 1."""
    return np.array([capsule.link for capsule in arm.capsules], np.intp)


@functools.cache
def on_hand(arm: Arm) -> NDArray[np.bool_]:
    """(C,) true for capsules on the hand: the last two links."""
    return capsule_links(arm) > arm.n - _HAND_LINKS


@functools.cache
def on_middle(arm: Arm) -> NDArray[np.bool_]:
    """(C,) true for capsules on the middle links: those from the third to the hand, elbow and forearm."""
    return (capsule_links(arm) >= _FIRST_MIDDLE_LINK) & ~on_hand(arm)


def capsule_segments(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Start and end points of the arm's capsules at `q` (n,), rad, in the base frame, (C, 3) each, m."""
    rotations, origins = link_frames(arm, q)
    starts, ends = [], []
    for capsule in arm.capsules:
        rotation, origin = rotations[capsule.link - 1], origins[capsule.link - 1]
        starts.append(origin + rotation @ capsule.start)
        ends.append(origin + rotation @ capsule.end)
    return np.array(starts), np.array(ends)


def path_segments(arm: Arm, path: Array) -> tuple[Array, Array]:
    """Capsule segments along a path (N, n): (N, C, 3) each."""
    pairs = [capsule_segments(arm, q) for q in path]
    return np.array([starts for starts, _ in pairs]), np.array([ends for _, ends in pairs])


def swivelled_segments(arm: Arm, q: Array, angles: Array) -> tuple[Array, Array]:
    """The capsules in the postures that hold the flange pose of `q` (n,), (A, C, 3) each.

    All links but the hand turn by `angles` (A,), rad, about the line from the shoulder to the wrist, the origin of the
    last link but one. Where the axes of the last three joints meet there, as those of an iiwa do, a full turn covers
    every such posture, whether or not the joints can reach it.
    """
    starts, ends = capsule_segments(arm, q)
    _, origins = link_frames(arm, q)
    shoulder = np.array(arm.shoulder)
    axis = origins[arm.n - _HAND_LINKS] - shoulder
    axis /= np.linalg.norm(axis)
    turns = np.array([rotation_about(axis, angle) for angle in angles])

    def turned(points: Array) -> Array:
        swivelled = shoulder + np.einsum("aij,cj->aci", turns, points - shoulder)
        return np.where(on_hand(arm)[:, None], points, swivelled)

    return turned(starts), turned(ends)


def holding_segments(arm: Arm, q: Array) -> tuple[Array, Array]:
    """The capsules in the postures that hold the tip pose of `q` (n,), (A, C, 3) each.

    Swivelled ones, if the last three axes meet; otherwise those that were found within the joint limits.
    """
    rotations, origins = link_frames(arm, q)
    wrist = origins[arm.n - _HAND_LINKS]
    if arm.n == 7 and all(
        np.linalg.norm(np.cross(rotations[joint][:, 2], origins[joint] - wrist)) < _MEETING for joint in (-4, -2)
    ):
        return swivelled_segments(arm, q, _SWIVELS)
    return path_segments(arm, np.concatenate([q[None], postures_at(arm, origins[-1], rotations[-1])]))


def postures_at(arm: Arm, position: Array, rotation: Array) -> Array:
    """Postures (N, n) with a tip pose, from random ones: those of a redundant arm lie along its free dimension."""
    seeds = np.random.default_rng(0).uniform(
        np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi), (_SEEDS, arm.n)
    )
    return solve_ik(arm, position, rotation, seeds, _LIMIT_MARGIN)


def height(arm: Arm, q: Array, depth: float) -> float:
    """Height of the part of hand and forearm that is at most `depth` behind the tip along x, in a posture (n,), m."""
    (starts, ends), beyond = capsule_segments(arm, q), capsule_links(arm) > _FIRST_MIDDLE_LINK
    points = starts[:, None] + _POINTS[:, None] * (ends - starts)[:, None]
    counts = beyond[:, None] & (points[..., 0] >= link_frames(arm, q)[1][-1][0] - depth)
    above, below = points[..., 2] + radii(arm)[:, None], points[..., 2] - radii(arm)[:, None]
    return float(above[counts].max(initial=-np.inf) - below[counts].min(initial=np.inf))


def overlap_depths(arm: Arm, starts: Array, ends: Array, centers: Array, radius: float) -> Array:
    """How deep each sphere lies in each capsule, (..., C, P), m; negative values are distances.

    `starts` and `ends` are (..., C, 3), `centers` (P, 3).
    """
    axis = (ends - starts)[..., None, :]
    offset = centers - starts[..., None, :]
    share = np.clip(np.sum(offset * axis, axis=-1) / np.sum(axis * axis, axis=-1), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * axis, axis=-1)
    return radii(arm)[:, None] + radius - distance


def base_distances(arm: Arm, points: Array) -> Array:
    """Distances of points (..., 3) from the surface of the base, (...), m; negative inside."""
    capsule = arm.base_capsule
    offset = points - np.array(capsule.start)
    offset[..., 2] = points[..., 2] - np.clip(points[..., 2], capsule.start[2], capsule.end[2])
    return np.linalg.norm(offset, axis=-1) - capsule.radius
