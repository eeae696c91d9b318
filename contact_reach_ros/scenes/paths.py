"""Paths, postures and links that random scenes are built around, by kinematics alone."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.kinematics import link_frames, rotation_about
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.world.collision import capsule_segments

MIN_MOBILITY = 0.05
"""Smallest eigenvalue of J M⁻¹ Jᵀ, 1/kg, below which a configuration counts as singular."""

_STEP = 0.004
"""Of a free path along its line, m."""
_SETTLING = 5
"""Iterations at the end of a free path."""
_PATH_MARGIN, _POSTURE_MARGIN = 0.2, 0.1
"""Least distances of joints from their limits along a free path, and in postures with one tip pose, rad."""
_HAND_LINKS = 2
"""Number of links, counted from the tip, that make up the hand."""
_FIRST_MIDDLE_LINK = 3
_MEETING = 1e-6
"""Distance up to which axes meet, m."""
_SWIVELS = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
_SEEDS = 200
"""Random postures from which the search for those with one tip pose starts."""


def free_path(model: RobotModel, start: Array, target: Array) -> Array | None:
    """Joint angles (N, n) along the straight line to a flange position, orientation held, least joint motion.

    Inverse kinematics in steps of a few millimetres with the dynamically consistent inverse, as the impedance law would
    move the arm. None if the line leaves the workspace, or comes near a singularity (`MIN_MOBILITY`) or within 0.2 rad
    of a joint limit.
    """
    lower, upper = model.arm.lower + _PATH_MARGIN, model.arm.upper - _PATH_MARGIN
    q, v = start.copy(), np.zeros_like(start)
    model.update(q, v)
    origin, rotation = model.position.copy(), model.rotation.copy()
    count = int(np.ceil(np.linalg.norm(target - origin) / _STEP))
    path = [q.copy()]
    for share in (*np.linspace(0.0, 1.0, count + 1)[1:], *np.ones(_SETTLING)):
        error = np.empty(6)
        error[:3] = model.position - origin - share * (target - origin)
        error[3:] = 0.5 * sum(np.cross(rotation[:, k], model.rotation[:, k]) for k in range(3))
        if model.smallest_mobility() < MIN_MOBILITY:
            return None
        inverse_mass_jacobian = np.linalg.solve(model.mass_matrix, model.jacobian.T)
        q = q - inverse_mass_jacobian @ np.linalg.solve(model.jacobian @ inverse_mass_jacobian, error)
        if ((q < lower) | (q > upper)).any():
            return None
        path.append(q.copy())
        model.update(q, v)
    return np.array(path) if np.linalg.norm(model.position - target) < 1e-3 else None


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
    """(C,) true for capsules on elbow and forearm: the links from the third to the hand."""
    return (capsule_links(arm) >= _FIRST_MIDDLE_LINK) & ~on_hand(arm)


def path_segments(arm: Arm, path: Array) -> tuple[Array, Array]:
    """Capsule segments along a path (N, n), rad: (N, C, 3) each, m."""
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
    return solve_ik(arm, position, rotation, seeds, _POSTURE_MARGIN)
