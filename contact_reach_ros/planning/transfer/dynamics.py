"""Mass matrix and Jacobian of all lanes, with every spatial quantity taken about the flange.

With the flange as the one reference point, the joints' motion vectors are the columns of the Jacobian, and composite
inertias are plain sums.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.transfer.arithmetic import (
    combine,
    cosine_and_sine,
    cross,
    dot,
    per_link,
    pick,
    prefix_sum,
    suffix_sum,
    sum_over,
)
from contact_reach_ros.planning.transfer.model import ArmModel


class Frames(NamedTuple):
    """Link frames in the base frame; axes are the columns of the rotation matrices."""

    x: jax.Array
    """(3, n, B)."""
    y: jax.Array
    """(3, n, B)."""
    z: jax.Array
    """(3, n, B), the joint axes."""
    origin: jax.Array
    """(3, n, B), m."""
    flange: jax.Array
    """(3, B), m."""
    flange_axes: tuple[jax.Array, ...]
    """Its x, y and z axis, (3, B) each."""

    @property
    def flange_rotation(self) -> jax.Array:
        """(3, 3, B), indexed [row, column]."""
        return jnp.stack(self.flange_axes, axis=1)


def link_frames(arm: ArmModel, q: jax.Array) -> Frames:
    """Frames of the links at joint angles `q` (n, B)."""
    cosine, sine = cosine_and_sine(q)
    identity = np.eye(3)[:, :, None]
    axes = [jnp.broadcast_to(identity[:, column], (3, q.shape[1])).astype(q.dtype) for column in range(3)]
    origin = jnp.zeros_like(axes[0])
    frames = []
    for joint in range(arm.n):
        origin = origin + combine(axes, arm.joint_offset[joint])
        x, y, z = (combine(axes, arm.joint_rotation[joint][:, column]) for column in range(3))
        axes = [x * cosine[joint] + y * sine[joint], y * cosine[joint] - x * sine[joint], z]
        frames.append((*axes, origin))
    flange = origin + combine(axes, arm.flange_offset)
    x, y, z, origins = (jnp.stack(parts, axis=1) for parts in zip(*frames, strict=True))
    last = [x[:, -1], y[:, -1], z[:, -1]]
    flange_axes = tuple(combine(last, arm.flange_rotation[:, column]) for column in range(3))
    return Frames(x, y, z, origins, flange, flange_axes)


class Capsules(NamedTuple):
    """Segments of the arm's capsules in the base frame."""

    start: jax.Array
    """(..., 3, C, B), m."""
    axis: jax.Array
    """(..., 3, C, B) from there to their ends, m."""


def place_capsules(arm: ArmModel, frames: Frames) -> Capsules:
    """The arm's capsules with the links at the given frames."""
    axes = [pick(axis, arm.capsule_link) for axis in (frames.x, frames.y, frames.z)]
    start = pick(frames.origin, arm.capsule_link) + combine(axes, per_link(arm.capsule_start))
    return Capsules(start, combine(axes, per_link(arm.capsule_axis)))


def flange_drift(frames: Frames, v: jax.Array) -> jax.Array:
    """J̇ q̇ (6, B): the flange's acceleration, linear then angular, while the joints keep their speeds `v` (n, B)."""
    rates = frames.z * v
    angular_velocity = prefix_sum(rates)
    angular_acceleration = prefix_sum(cross(angular_velocity, rates))
    ends = jnp.concatenate([frames.origin[:, 1:], frames.flange[:, None]], axis=1)
    lever = ends - frames.origin
    centripetal = cross(angular_velocity, cross(angular_velocity, lever))
    linear = cross(angular_acceleration, lever) + centripetal
    return jnp.concatenate([sum_over(linear, 1), angular_acceleration[:, -1]])


_CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
"""Each axis with the two that follow it."""


class Dynamics(NamedTuple):
    """What law (3) and the equation of motion need from the arm."""

    jacobian: jax.Array
    """(6, n, B): linear then angular velocity of the flange, base axes."""
    mass_matrix: jax.Array
    """(n, n, B), kg m², armature included; only entries [i, j] with i ≤ j are valid."""


def arm_dynamics(arm: ArmModel, frames: Frames) -> Dynamics:
    """Jacobian and mass matrix at the given frames, by the composite-rigid-body algorithm."""
    axis = frames.z
    jacobian = jnp.concatenate([cross(axis, frames.flange[:, None] - frames.origin), axis])
    # First moment, moments (xx, yy, zz) and products (yz, zx, xy) of the links from each one on, each (3, n, B).
    axes = (frames.x, frames.y, frames.z)
    center = frames.origin + combine(axes, per_link(arm.center_of_mass)) - frames.flange[:, None]
    first = center * arm.mass[:, None]
    diagonal = dot(first, center)[None] - first * center
    products = [-first[b] * center[c] for _, b, c in _CYCLES]
    # Σ_ab I_ab axis_a axis_bᵀ, the inertia about the centre of mass in base axes.
    for index, own in enumerate(axes):
        column = combine(axes, per_link(arm.inertia[:, index]))
        diagonal = diagonal + column * own
        products = [product + column[b] * own[c] for product, (_, b, c) in zip(products, _CYCLES, strict=True)]
    parts = (first, diagonal, jnp.stack(products))
    first, diagonal, off_diagonal = (suffix_sum(part) for part in parts)
    composite_mass = np.cumsum(arm.mass[::-1])[::-1][:, None]
    # Component by component: XLA computes stacked rows several times slower than separate ones.
    # Momentum of everything beyond a joint when that joint alone turns at unit speed.
    velocity = jacobian[:3]
    linear = [velocity[a] * composite_mass + axis[b] * first[c] - axis[c] * first[b] for a, b, c in _CYCLES]
    # Row a of the inertia tensor: its moment and the products with b and c.
    angular = [
        first[b] * velocity[c]
        - first[c] * velocity[b]
        + diagonal[a] * axis[a]
        + off_diagonal[c] * axis[b]
        + off_diagonal[b] * axis[c]
        for a, b, c in _CYCLES
    ]
    momentum = [*linear, *angular]
    # Outer products summed in this form are 20 times faster than a contraction.
    mass_matrix = jacobian[0][:, None] * momentum[0][None]
    for row in range(1, 6):
        mass_matrix = mass_matrix + jacobian[row][:, None] * momentum[row][None]
    return Dynamics(jacobian, mass_matrix + np.diag(arm.armature)[:, :, None])
