"""Distances of the link capsules from rigid bodies and from each other, for all lanes at once.

A distance has its derivative at fixed nearest points: where these are optimal, moving them changes nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.transfer.arithmetic import dot, sum_over
from contact_reach_ros.planning.transfer.dynamics import Capsules
from contact_reach_ros.planning.transfer.model import ArmModel

_NEWTON_STEPS = 2
"""Of the search for the point of a segment that is nearest to a block: more than 1 mm off in 1 of 10,000 cases."""


class Bodies(NamedTuple):
    """Rigid bodies in the base frame, the same in every lane."""

    normal: jax.Array
    """(3, P, 1) of planes, unit vectors towards the arm."""
    offset: jax.Array
    """(P, 1) distance of the planes from the origin along their normals, m."""
    center: jax.Array
    """(3, Q, 1) of blocks, m."""
    axes: jax.Array
    """(3, 3, Q, 1) axes of the blocks, indexed [axis, coordinate]."""
    half: jax.Array
    """(3, Q, 1) half of their size along these axes, m."""


def intrusions(
    arm: ArmModel, capsules: Capsules, bodies: Bodies | None, margin: float | jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Σ max(margin − distance, 0)² (..., B), m²: over the arm's own pairs that can touch, and over capsules and bodies.

    Parameters
    ----------
    arm
        Its constants.
    capsules
        In the base frame.
    bodies
        Rigid bodies; None leaves the arm's own pairs.
    margin
        Distance at which it starts, m.
    """
    start, axis = (jnp.moveaxis(points, -3, 0) for points in capsules)
    distances: list[jax.Array] = []
    if bodies is not None:
        radius = arm.capsule_radius[:, None]
        for plane in range(bodies.offset.shape[0]):
            normal = bodies.normal[:, plane]
            nearest = dot(normal, start) - bodies.offset[plane] + jnp.minimum(dot(normal, axis), 0.0)
            distances.append(nearest - radius)
        distances += [distance - radius for distance in _from_blocks(bodies, start, axis)]

    def total(distances: list[jax.Array]) -> jax.Array:
        found = jnp.zeros((*start.shape[1:-2], start.shape[-1]), start.dtype)
        for distance in distances:
            short = jnp.maximum(margin - distance, 0.0)
            found = found + sum_over(short * short, distance.ndim - 2)
        return found

    return total(_between_capsules(arm, start, axis)), total(distances)


def _from_blocks(bodies: Bodies, start: jax.Array, axis: jax.Array) -> list[jax.Array]:
    """Distances (..., C, B) of segments (3, ..., C, B) from each block, m; zero where they enter it.

    Along a segment the squared distance is convex and piecewise quadratic: Newton's method from the middle finds its
    least value.
    """
    distances = []
    for block in range(bodies.half.shape[1]):
        axes, half = bodies.axes[:, :, block], bodies.half[:, block]
        from_center = [start[row] - bodies.center[row, block] for row in range(3)]
        origin = jnp.stack([dot(own, from_center) for own in axes])
        along = jnp.stack([dot(own, axis) for own in axes])
        share = jnp.full(start.shape[1:], 0.5, start.dtype)
        for _ in range(_NEWTON_STEPS):
            beyond = _beyond(half, origin, along, share)
            slope = dot(beyond, along)
            curvature = dot([jnp.where(beyond[row] == 0.0, 0.0, along[row]) for row in range(3)], along)
            share = jnp.clip(share - slope / (curvature + 1e-9), 0.0, 1.0)
        beyond = _beyond(half, origin, along, jax.lax.stop_gradient(share))
        distances.append(jnp.sqrt(dot(beyond, beyond) + 1e-12))
    return distances


def _beyond(half: jax.Array, start: jax.Array, axis: jax.Array, share: jax.Array) -> list[jax.Array]:
    """Components (..., C, B) of the vectors from a block's nearest points to a share of segments, in its axes."""
    points = [start[row] + share * axis[row] for row in range(3)]
    return [point - jnp.clip(point, -half[row], half[row]) for row, point in enumerate(points)]


def _between_capsules(arm: ArmModel, start: jax.Array, axis: jax.Array) -> list[jax.Array]:
    """Distances (..., P, B) of the capsules of the arm's own pairs, m, in one array; none for an arm without any."""
    pairs = arm.self_pairs
    if not pairs:
        return []
    shape = (3, *start.shape[1:-2], 1, start.shape[-1])

    def fixed(values: np.ndarray) -> jax.Array:
        return jnp.broadcast_to(values.astype(start.dtype).reshape(3, *[1] * (start.ndim - 1)), shape)

    starts = [*map(fixed, arm.base_start), *jnp.split(start, start.shape[-2], axis=-2)]
    axes = [*map(fixed, arm.base_axis), *jnp.split(axis, axis.shape[-2], axis=-2)]
    sides = [
        jnp.concatenate([parts[pair[side]] for pair in pairs], axis=-2) for side in range(2) for parts in (starts, axes)
    ]
    radii = np.array([*arm.base_radius, *arm.capsule_radius])
    reach = np.array([radii[first] + radii[second] for first, second in pairs])
    return [_between(*sides) - reach[:, None]]


def _between(start: jax.Array, segment: jax.Array, other_start: jax.Array, other: jax.Array) -> jax.Array:
    """Distance (..., P, B) of pairs of segments (3, ..., P, B), m, as `arm.capsules.segment_distances`."""
    between = start - other_start
    a, e, b = dot(segment, segment), dot(other, other), dot(segment, other)
    c, f = dot(segment, between), dot(other, between)
    share = jnp.clip((b * f - c * e) / jnp.maximum(a * e - b * b, 1e-9), 0.0, 1.0)
    across = jnp.clip((b * share + f) / e, 0.0, 1.0)
    share = jnp.clip((b * across - c) / a, 0.0, 1.0)
    share, across = jax.lax.stop_gradient(share), jax.lax.stop_gradient(across)
    gap = between + share * segment - across * other
    return jnp.sqrt(dot(gap, gap) + 1e-12)
