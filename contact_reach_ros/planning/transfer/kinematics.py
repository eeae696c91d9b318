"""Forward kinematics of all lanes at once."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.transfer.lanes import Keep, combine, cosine_and_sine, cross, per_link, pick, prefix_sum
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


def link_frames(arm: ArmModel, q: jax.Array, keep: Keep) -> Frames:
    """Frames of the links at joint angles `q` (n, B)."""
    cosine, sine = (keep(part) for part in cosine_and_sine(q))
    identity = np.eye(3)[:, :, None]
    axes = [jnp.broadcast_to(identity[:, column], (3, q.shape[1])).astype(q.dtype) for column in range(3)]
    origin = jnp.zeros_like(axes[0])
    frames = []
    for joint in range(arm.n):
        origin = keep(origin + combine(axes, arm.joint_offset[joint]))
        x, y, z = (combine(axes, arm.joint_rotation[joint][:, column]) for column in range(3))
        axes = [keep(x * cosine[joint] + y * sine[joint]), keep(y * cosine[joint] - x * sine[joint]), z]
        frames.append((*axes, origin))
    flange = origin + combine(axes, arm.flange_offset)
    x, y, z, origins = (jnp.stack(parts, axis=1) for parts in zip(*frames, strict=True))
    last = [x[:, -1], y[:, -1], z[:, -1]]
    flange_axes = tuple(combine(last, arm.flange_rotation[:, column]) for column in range(3))
    return Frames(x, y, z, origins, flange, flange_axes)


def capsule_segments(arm: ArmModel, frames: Frames) -> tuple[jax.Array, jax.Array]:
    """Start points (3, C, B) of the capsules and vectors (3, C, B) from there to their ends, m."""
    axes = [pick(axis, arm.capsule_link) for axis in (frames.x, frames.y, frames.z)]
    start = pick(frames.origin, arm.capsule_link) + combine(axes, per_link(arm.capsule_start))
    return start, combine(axes, per_link(arm.capsule_axis))


def flange_drift(frames: Frames, v: jax.Array, keep: Keep) -> jax.Array:
    """J̇ q̇ (6, B): the flange's acceleration, linear then angular, while the joints keep their speeds `v` (n, B)."""
    rates = frames.z * v
    angular_velocity = keep(prefix_sum(rates))
    angular_acceleration = keep(prefix_sum(cross(angular_velocity, rates)))
    ends = jnp.concatenate([frames.origin[:, 1:], frames.flange[:, None]], axis=1)
    lever = ends - frames.origin
    centripetal = cross(angular_velocity, keep(cross(angular_velocity, lever)))
    linear = keep(cross(angular_acceleration, lever) + centripetal)
    total = linear[:, 0]
    for link in range(1, linear.shape[1]):
        total = total + linear[:, link]
    return jnp.concatenate([total, angular_acceleration[:, -1]])
