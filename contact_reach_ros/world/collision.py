"""How near the arm is to rigid bodies, to soft spheres and to itself."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from contact_reach_ros.arm import Arm, Array, rotation_from_quaternion
from contact_reach_ros.arm.capsules import (
    moving,
    pairs_apart,
    segment_distances,
    self_pairs,
    shape_name,
    shape_radii,
    shape_segments,
    shapes,
)
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.errors import InputError
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.rigid import Block, Environment, Plane, RigidBody, point_distances
from contact_reach_ros.world.spheres import Spheres

GOAL_CLEARANCE = 0.005
"""Least distance of the hand from rigid bodies at a goal, m: nearer, the planner's margin would keep it away."""
_SAMPLES, _ROUNDS = 17, 3
_SEEDS = 64
"""Random postures from which a posture for a goal is sought: that found all of 2000 poses of random postures, and of an
arm with six joints all but one."""

_Body = TypeVar("_Body", Plane, Block)


class Nearest(NamedTuple):
    """Two things that are nearest to each other, one of them a link."""

    distance: float
    """Between their surfaces, m; negative where they overlap."""
    link: str
    other: str
    """A rigid body or another link."""

    def __str__(self) -> str:
        if self.distance < 0.0:
            return f"{self.link} lies {-1000 * self.distance:.1f} mm deep in {self.other}"
        return f"{self.link} is {1000 * self.distance:.1f} mm away from {self.other}"


def nearest(arm: Arm, q: Array, environment: Environment, itself: bool = True) -> list[Nearest]:
    """In each of the postures `q` (N, n), rad: of the pairs of arm and bodies, and of arm and `itself`, the nearest.

    The list is empty if there is nothing that could touch.
    """
    pairs = self_pairs(arm) if itself else ()
    links = range(len(arm.base_capsules), len(shapes(arm)))
    names = [(shape_name(arm, second), shape_name(arm, first)) for first, second in pairs]
    # The base does not move: the bodies that it stands on or beside are no concern of it.
    names += [(shape_name(arm, shape), f"the {body.name}") for body in environment for shape in links]
    if not names:
        return []
    segments = shape_segments(arm, q)
    own = pairs_apart(arm, segments, np.array(pairs)) if pairs else np.full((len(q), 0), np.inf)
    starts, ends = (points[:, moving(arm)] for points in segments)
    radii = shape_radii(arm)[moving(arm)]
    middles, slack = _middle_distances(environment, starts, ends)
    limit = np.minimum((middles - radii).min(axis=(0, 2), initial=np.inf), own.min(axis=1, initial=np.inf))
    # All others are farther than the nearest, whichever of their points is nearest.
    candidates = middles - slack - radii <= limit[:, None]
    for index in np.flatnonzero(candidates.any(axis=(1, 2))):
        chosen = candidates[index]
        middles[index, chosen] = body_distances(environment[index], starts[chosen], ends[chosen])
    distances = np.concatenate([own, *(middles - radii)], axis=1)
    which = distances.argmin(axis=1)
    return [Nearest(float(row[index]), *names[index]) for row, index in zip(distances, which, strict=True)]


def nearest_of(bodies: tuple[_Body, ...], count: int, starts: Array, ends: Array) -> tuple[_Body, ...]:
    """The `count` bodies that are nearest to any of the segments from `starts` to `ends`, (C, 3) each, m."""
    if len(bodies) <= count:
        return bodies
    middles, slack = _middle_distances(bodies, starts[None], ends[None])
    limit = np.sort(middles.min(axis=(1, 2)))[count - 1]
    candidates = [bodies[index] for index in np.flatnonzero((middles - slack).min(axis=(1, 2)) <= limit)]
    return tuple(sorted(candidates, key=lambda body: float(body_distances(body, starts, ends).min()))[:count])


def _middle_distances(environment: Environment, starts: Array, ends: Array) -> tuple[Array, Array]:
    """Distances (B, N, C) of segments' middles from the bodies, and by how much (N, C) their ends may be nearer, m."""
    return point_distances(environment, 0.5 * (starts + ends)), 0.5 * np.linalg.norm(ends - starts, axis=-1)


def body_distances(body: RigidBody, starts: Array, ends: Array) -> Array:
    """Distances (...) of segments from `starts` to `ends`, (..., 3) each, from a body's surface, m; negative inside.

    The distance from a convex body is convex along a segment: the least of some samples, then of closer ones around it.
    From a plane it is that of an end.
    """
    if isinstance(body, Plane):
        return np.minimum(*(point_distances((body,), points)[0] for points in (starts, ends)))
    low, high = np.zeros(starts.shape[:-1]), np.ones(starts.shape[:-1])
    grid = np.linspace(0.0, 1.0, _SAMPLES)
    for _ in range(_ROUNDS):
        shares = low[..., None] + grid * (high - low)[..., None]
        points = starts[..., None, :] + shares[..., None] * (ends - starts)[..., None, :]
        distances = point_distances((body,), points)[0]
        best = np.take_along_axis(shares, distances.argmin(axis=-1)[..., None], axis=-1)[..., 0]
        step = (high - low) / (_SAMPLES - 1)
        low, high = np.maximum(best - step, 0.0), np.minimum(best + step, 1.0)
    return distances.min(axis=-1)


def capsule_segments(arm: Arm, q: Array) -> tuple[Array, Array]:
    """Start and end points of the moving links' capsules at `q` (..., n), rad, base frame, (..., C, 3) each, m."""
    starts, ends = (points[:, moving(arm)] for points in shape_segments(arm, q.reshape(-1, arm.n)))
    shape = (*q.shape[:-1], *starts.shape[1:])
    return starts.reshape(shape), ends.reshape(shape)


def overlap_depths(arm: Arm, starts: Array, ends: Array, centers: Array, radius: float | Array) -> Array:
    """How deep each sphere lies in each capsule, (..., C, K), m; negative values are distances.

    `starts` and `ends`, (..., C, 3) each, m, belong to the moving links' capsules, or to all `shapes`; `centers` are
    (K, 3), m, and `radius` is one for all spheres or (K,), m.
    """
    axes = ends - starts
    lengths = (axes * axes).sum(axis=-1)[..., None]
    # Squares are multiplied out: products of matrices take a fifth of the time of arrays (..., C, K, 3).
    along = axes @ centers.T - (axes * starts).sum(axis=-1)[..., None]
    squares = (centers**2).sum(axis=-1) - 2.0 * (starts @ centers.T) + (starts**2).sum(axis=-1)[..., None]
    share = np.clip(along / lengths, 0.0, 1.0)
    distance = np.sqrt(np.maximum(squares + share * (share * lengths - 2.0 * along), 0.0))
    # The moving links' capsules are the last of the shapes.
    return shape_radii(arm)[-starts.shape[-2] :, None] + radius - distance


def clearances(arm: Arm, q: Array, spheres: Spheres) -> Array:
    """Distance (K,) of each sphere's surface from the nearest link capsule at joint angles `q` (n,), m."""
    return -overlap_depths(arm, *capsule_segments(arm, q), spheres.center, spheres.radius).max(axis=0, initial=-np.inf)


def check_goal(arm: Arm, goal: Target, environment: Environment, q: Array) -> None:
    """Refuse a goal that no posture attains, or at which the hand would be in a rigid body or in the arm's base.

    This is the rule for every goal: those of the planner's node, of `Stack` and of scenes. `q`: the present posture
    (n,), rad.

    Raises
    ------
    InputError
        With what is in the way, and what to change.
    """
    check_hand(arm, goal, environment)
    # The same seeds each time: so is the answer, within 10 ms, or 0.1 s where there is none.
    drawn = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_SEEDS, arm.n))
    seeds = np.concatenate([[q, arm.home], drawn])
    if not len(solve_ik(arm, goal.position, goal.rotation, seeds, 0.0, goal.only_axis, first=True)):
        held = goal.rotation is not None
        remedy = "choose another position, or another orientation" if held else "choose another position"
        raise InputError(
            f"goal: position = {np.round(goal.position, 3).tolist()} m; no posture within the joint limits has the "
            f"flange there{' in this orientation' if held else ''}: {remedy}"
        )


def check_hand(arm: Arm, goal: Target, environment: Environment) -> None:
    """Refuse a goal at which the hand would be in a rigid body or in the arm's base.

    The hand is what the last link carries or, where the goal leaves a rotation free, the ball around the flange
    that this fills in every orientation.

    Raises
    ------
    InputError
        With the body, how deep the hand would be in it and how far to move the goal.
    """
    starts, ends, radii = _hand(arm, goal)
    distances, names = [], []
    for shape, fixed in enumerate(arm.base_capsules):
        ends_of_it = np.array([[fixed.start, fixed.end]] * len(radii), float)
        apart = segment_distances((starts, ends), (ends_of_it[:, 0], ends_of_it[:, 1]))
        distances.append((apart - radii - fixed.radius).min())
        names.append(shape_name(arm, shape))
    distances += [(body_distances(body, starts, ends) - radii).min() for body in environment]
    names += [f"the {body.name}" for body in environment]
    if not distances:
        return
    index = int(np.argmin(distances))
    distance = float(distances[index])
    if distance < GOAL_CLEARANCE:
        there = Nearest(distance, arm.link_names[-1], names[index])
        raise InputError(
            f"goal: position = {np.round(goal.position, 3).tolist()} m; there {there}; expected at least "
            f"{1000 * GOAL_CLEARANCE:g} mm between them: move the goal by {1000 * (GOAL_CLEARANCE - distance):.1f} mm "
            "or turn the hand"
        )


def _hand(arm: Arm, goal: Target) -> tuple[Array, Array, Array]:
    """Starts and ends (C, 3) and radii (C,) of what a goal places, m."""
    capsules = [capsule for capsule in arm.capsules if capsule.link == arm.n]
    tip = np.array(arm.tip_offset)
    starts, ends = (
        np.array([tip, *(capsule.start for capsule in capsules)]),
        np.array([tip, *(c.end for c in capsules)]),
    )
    radii = np.array([0.0, *(capsule.radius for capsule in capsules)])
    # What every orientation has in common.
    radii[0] = max(0.0, (radii - segment_distances((starts, ends), (tip, tip)))[1:].max(initial=0.0))
    if goal.rotation is None or goal.only_axis:
        return goal.position[None], goal.position[None], radii[:1]
    # Of the last link, whose frame the capsules are in.
    rotation = goal.rotation @ rotation_from_quaternion(arm.tip_rotation).T
    return goal.position + (starts - tip) @ rotation.T, goal.position + (ends - tip) @ rotation.T, radii
