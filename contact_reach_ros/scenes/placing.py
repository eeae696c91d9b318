"""Places for obstacles on the arm's free path, in the way of elbow and forearm; paths and postures by kinematics."""

from __future__ import annotations

import functools
from typing import cast

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.arm.capsules import moving, shape_radii, shape_segments
from contact_reach_ros.arm.inverse_kinematics import pose_errors, solve_ik
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SceneError
from contact_reach_ros.world.collision import capsule_segments, overlap_depths
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import BallSettings, ObstacleSettings, WallSettings

_REACH = 0.85
"""Reach of the iiwa 14, for which the lengths below were chosen, m; other arms have them in proportion."""
_START_CLEARANCE = 0.01
"""Least distance of the arm from obstacles at the start, m."""

_BALL_TRIES = 200
_MIN_SWEEP = 0.05
"""A ball cannot block a part of the arm that moves less than this, m, whatever its reach."""
_BALL_OVERLAP = (0.02, 0.05)
"""Least and greatest depth at which the free path enters the ball, m: noticed by the arm, within the contact budget."""
_HAND_CLEARANCE = 0.02
"""Least distance of the hand from the ball on the free path, m: only elbow and forearm are in its way."""

_WALL_TRIES = 40
_SPREAD = 0.01
"""How far the gap's centre may be above or below that of the passing hand, m, whatever its reach."""
_PATH_STEP = 5
_WALL_OVERLAP = (0.04, 0.15)
"""Least and greatest depth at which elbow and forearm enter a node on the free path, m."""
_MAX_HAND_OVERLAP = 0.02
"""Greatest depth at which the hand enters a node on the free path, m: it passes the gap with a squeeze."""
_MIN_SQUEEZE = 0.005
"""Least depth at which the arm enters a node in every posture that holds the target pose, m: none is free."""
_TARGET_CLEARANCE = 0.06
"""Least distance of the target behind the walls, m."""

MIN_MOBILITY, MIN_MOBILITY_SHARE = 0.05, 0.64
"""Smallest eigenvalue of J M⁻¹ Jᵀ below which a configuration counts as singular, 1/kg; for an arm whose best one has
less than 0.08, a share of that."""
_MOBILITY_POSTURES = 500

_STEP = 0.004
"""Of a free path along its line, m."""
_SETTLING = 5
"""Iterations at the end of a free path."""
_PATH_MARGIN, _POSTURE_MARGIN = 0.2, 0.1
"""Least distances of joints from their limits along a free path, and in postures with one tip pose, rad."""
_FIRST_MIDDLE_LINK = 3
_MEETING = 1e-6
"""Distance up to which axes meet, m."""
_SWIVELS = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
_SEEDS = 200
"""Random postures from which the search for those with one tip pose starts."""


def target_clearance(arm: Arm) -> float:
    """Least distance of a target behind the walls, m."""
    return arm.reach / _REACH * _TARGET_CLEARANCE


def place(section: ObstacleSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """The centre (3,), m, of a section's obstacles: its own, or a random one on the arm's free path (N, n), rad.

    None if no place on the path fits.
    """
    if section.center is not None:
        return np.array(section.center)
    if isinstance(section, BallSettings):
        return place_ball(section, arm, path, random)
    return place_walls(cast(WallSettings, section), arm, path, random)


def place_ball(ball: BallSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """A centre (3,) in the way of elbow or forearm on the path, but not of hand or start; None if none fits."""
    starts, ends = capsule_segments(arm, path)
    middle, hand = on_middle(arm), on_hand(arm)
    standing = shape_segments(arm, path[:1])
    scale = arm.reach / _REACH
    least, most = scale * _BALL_OVERLAP[0], scale * _BALL_OVERLAP[1]
    for _ in range(_BALL_TRIES):
        capsule = int(random.choice(np.flatnonzero(middle)))
        moment = int(random.uniform(0.3, 0.9) * len(path))
        along = random.uniform()
        points = starts[:, capsule] + along * (ends - starts)[:, capsule]
        if np.linalg.norm(points[moment] - points[0]) < _MIN_SWEEP:
            continue
        axis = ends[moment, capsule] - starts[moment, capsule]
        direction = points[moment] - points[moment - 5]
        direction -= axis * (direction @ axis) / (axis @ axis)
        direction /= max(float(np.linalg.norm(direction)), 1e-9)
        reach = shape_radii(arm)[moving(arm)][capsule] + ball.radius - random.uniform(least, most)
        center: Array = points[moment] + reach * direction
        depths = overlap_depths(arm, starts, ends, center[None], ball.radius)[..., 0]
        deepest = depths.max(axis=0)
        fits = least <= deepest[middle].max() <= most
        fits = fits and deepest[hand].max() <= -scale * _HAND_CLEARANCE
        fits = fits and depths[0].max() <= -scale * _START_CLEARANCE
        fits = fits and deepest[~middle & ~hand].max(initial=-np.inf) <= 0.0
        # The base is the first of the shapes.
        if fits and overlap_depths(arm, *standing, center[None], ball.radius)[0, 0, 0] < 0.0:
            return center
    return None


def place_walls(walls: WallSettings, arm: Arm, path: Array, random: np.random.Generator) -> Array | None:
    """A centre of the gap (3,) on the hand's path; None if none fits.

    The start is clear of the walls, the target lies behind them, elbow or forearm would push into them on the path,
    and no posture that holds the target pose is free of contact, so that there is no collision-free path.
    """
    starts, ends = capsule_segments(arm, np.concatenate([path[:-1:_PATH_STEP], path[-1:]]))
    holding = holding_segments(arm, path[-1])
    hand, middle = on_hand(arm), on_middle(arm)
    points = np.concatenate([starts[:, hand], ends[:, hand]], axis=1)
    reach = np.tile(shape_radii(arm)[moving(arm)][hand], 2)
    hand_middles = 0.5 * ((points[..., 2] + reach).max(axis=1) + (points[..., 2] - reach).min(axis=1))
    hand_x = ends[:, hand][:, -1, 0]
    half_thickness, scale = 0.5 * walls.size[0], arm.reach / _REACH
    least, most = scale * _WALL_OVERLAP[0], scale * _WALL_OVERLAP[1]
    nearest, farthest = hand_x[0] + half_thickness, hand_x[-1] - half_thickness - target_clearance(arm)
    if nearest > farthest:
        return None
    for _ in range(_WALL_TRIES):
        x = random.uniform(nearest, farthest)
        z = hand_middles[np.abs(hand_x - x).argmin()] + random.uniform(-_SPREAD, _SPREAD)
        center = np.array([x, 0.0, z])
        nodes = np.concatenate([wall.rest for wall in walls.at(center)])
        if overlap_depths(arm, starts[0], ends[0], nodes, walls.node_radius).max() > -scale * _START_CLEARANCE:
            continue
        deepest = overlap_depths(arm, starts, ends, nodes, walls.node_radius).max(axis=(0, 2))
        fits = least <= deepest[middle].max() <= most
        fits = fits and deepest[hand].max() <= scale * _MAX_HAND_OVERLAP
        if fits:
            squeezes = overlap_depths(arm, *holding, nodes, walls.node_radius).max(axis=(1, 2))
            if squeezes.min() >= scale * _MIN_SQUEEZE:
                return center
    return None


@functools.cache
def least_mobility(arm: Arm) -> float:
    """Smallest eigenvalue of J M⁻¹ Jᵀ, 1/kg, below which a configuration of this arm counts as singular.

    J has the rows of the arm's `task`.
    """
    model, best = RobotModel(arm), 0.0
    goal = Target(np.zeros(3), np.eye(3)).of_task(arm.task)
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_MOBILITY_POSTURES, arm.n))
    _, jacobians = pose_errors(arm, goal.position, goal.rotation, postures, goal.only_axis)
    for q, jacobian in zip(postures, jacobians, strict=True):
        model.update_dynamics(q)
        best = max(best, _smallest_mobility(jacobian, model.mass_matrix))
    return min(MIN_MOBILITY, MIN_MOBILITY_SHARE * best)


def _smallest_mobility(jacobian: Array, mass_matrix: Array) -> float:
    """Smallest eigenvalue of J M⁻¹ Jᵀ, 1/kg: zero where the arm is singular."""
    return float(np.linalg.eigvalsh(jacobian @ np.linalg.solve(mass_matrix, jacobian.T))[0])


def free_path(model: RobotModel, start: Array, target: Array) -> Array:
    """Joint angles (N, n) along the straight line to a flange position with the least joint motion.

    The orientation is held as far as the arm's `task` controls it.

    Inverse kinematics in steps of a few millimetres with the dynamically consistent inverse, as the impedance law would
    move the arm.

    Raises
    ------
    SceneError
        If the line leaves the workspace, or comes near a singularity (`least_mobility`) or within 0.2 rad of a joint
        limit; the message, without the target, says which, and names the joint.
    """
    arm, least = model.arm, least_mobility(model.arm)
    lower, upper = arm.lower + _PATH_MARGIN, arm.upper - _PATH_MARGIN
    q, (origin, rotation) = start.copy(), model.tip_pose(start)
    held = Target(origin, rotation).of_task(arm.task)
    count = int(np.ceil(np.linalg.norm(target - origin) / _STEP))
    path = [q.copy()]
    for share in (*np.linspace(0.0, 1.0, count + 1)[1:], *np.ones(_SETTLING)):
        here = origin + share * (target - origin)
        (error,), (jacobian,) = pose_errors(arm, here, held.rotation, q[None], held.only_axis)
        model.update_dynamics(q)
        if _smallest_mobility(jacobian, model.mass_matrix) < least:
            where = "comes near a singularity on the way" if len(path) > 1 else "starts near a singularity"
            raise SceneError(f"the arm {where}: its mobility is below {least:.2g} 1/kg")
        inverse_mass_jacobian = np.linalg.solve(model.mass_matrix, jacobian.T)
        q = q - inverse_mass_jacobian @ np.linalg.solve(jacobian @ inverse_mass_jacobian, error)
        if ((q < lower) | (q > upper)).any():
            joint = int(np.maximum(lower - q, q - upper).argmax())
            end = "upper" if q[joint] > upper[joint] else "lower"
            raise SceneError(
                f"joint '{arm.joint_names[joint]}' comes within {_PATH_MARGIN} rad of its {end} limit on the way"
            )
        path.append(q.copy())
    if np.linalg.norm(model.tip_pose(q)[0] - target) >= 1e-3:
        raise SceneError("the arm does not get there")
    return np.array(path)


@functools.cache
def capsule_links(arm: Arm) -> NDArray[np.intp]:
    """Number of the link that each capsule is on, (C,), counted from 1."""
    return np.array([capsule.link for capsule in arm.capsules], np.intp)


def _wrist(arm: Arm) -> int:
    """Number of the hand's first link, counted from 1: the last but one, or the last of four and fewer."""
    return arm.n - (arm.n > 4)


@functools.cache
def on_hand(arm: Arm) -> NDArray[np.bool_]:
    """(C,) true for capsules on the hand."""
    return capsule_links(arm) >= _wrist(arm)


@functools.cache
def on_middle(arm: Arm) -> NDArray[np.bool_]:
    """(C,) true for capsules on elbow and forearm: the links from the third to the hand, or the last before it."""
    return (capsule_links(arm) >= min(_FIRST_MIDDLE_LINK, _wrist(arm) - 1)) & ~on_hand(arm)


def swivelled_segments(arm: Arm, q: Array, angles: Array) -> tuple[Array, Array]:
    """The capsules in the postures that hold the flange pose of `q` (n,), (A, C, 3) each.

    All links but the hand turn by `angles` (A,), rad, about the line from the shoulder to the wrist, the origin of the
    last link but one. Where the axes of the last three joints meet there, as those of an iiwa do, a full turn covers
    every such posture, whether or not the joints can reach it.
    """
    starts, ends = capsule_segments(arm, q)
    _, origins = link_frames(arm, q)
    shoulder = np.array(arm.shoulder)
    axis = origins[_wrist(arm) - 1] - shoulder
    axis /= np.linalg.norm(axis)
    turns = np.array([pin.exp3(angle * axis) for angle in angles])

    def turned(points: Array) -> Array:
        swivelled = shoulder + np.einsum("aij,cj->aci", turns, points - shoulder)
        return np.where(on_hand(arm)[:, None], points, swivelled)

    return turned(starts), turned(ends)


def holding_segments(arm: Arm, q: Array) -> tuple[Array, Array]:
    """The capsules in the postures that hold the tip pose of `q` (n,), (A, C, 3) each.

    Swivelled ones, if the last three axes meet; otherwise those that were found within the joint limits.
    """
    rotations, origins = link_frames(arm, q)
    wrist = origins[_wrist(arm) - 1]
    if arm.n == 7 and all(
        np.linalg.norm(np.cross(rotations[joint][:, 2], origins[joint] - wrist)) < _MEETING for joint in (-4, -2)
    ):
        return swivelled_segments(arm, q, _SWIVELS)
    return capsule_segments(arm, np.concatenate([q[None], postures_at(arm, origins[-1], rotations[-1])]))


def postures_at(arm: Arm, position: Array, rotation: Array) -> Array:
    """Postures (N, n) with a tip pose, as far as the arm's `task` controls it, from random ones.

    Those of a redundant arm lie along its free dimensions.
    """
    seeds = np.random.default_rng(0).uniform(
        np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi), (_SEEDS, arm.n)
    )
    goal = Target(position, rotation).of_task(arm.task)
    return solve_ik(arm, position, goal.rotation, seeds, _POSTURE_MARGIN, goal.only_axis)
