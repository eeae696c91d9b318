"""Soft, frictionless contact between the link capsules and spheres, for all lanes at once.

A capsule and a sphere push each other apart along the line through the sphere's centre and the nearest point of the
capsule's segment, with a force of contact stiffness times penetration. Spheres are held by a spring and a damper and
have no mass: what they weigh does not matter at the speeds of this arm.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from contact_reach_ros.planning.transfer.kinematics import Frames
from contact_reach_ros.planning.transfer.lanes import Keep, combine, cross, dot, per_link, suffix_sum, sum_over
from contact_reach_ros.planning.transfer.model import N_CAPSULES, N_LINKS, ArmModel

_FIRST_LINK = N_LINKS - N_CAPSULES
"""The capsules belong to the last links, one each and in order."""


class Obstacles(NamedTuple):
    """Obstacle spheres in the base frame."""

    center: jax.Array
    """(3, K, B), m."""
    rest: jax.Array
    """(3, K, 1), m."""
    radius: jax.Array
    """(K, 1), m."""
    stiffness: jax.Array
    """(K, 1) of the spring to the rest position, N/m."""
    damping: jax.Array
    """(K, 1), N s/m."""


class Contact(NamedTuple):
    """Forces between arm and spheres."""

    joint_torque: jax.Array
    """(7, B) on the arm, N m."""
    link_force: jax.Array
    """(6, B) sum over the spheres of the (positive) normal forces on each capsule, N."""
    sphere_force: jax.Array
    """(3, K, B) on the spheres, N; the arm feels the opposite."""
    touching: jax.Array
    """(K, B) number of capsules that each sphere touches."""


def contact_forces(
    arm: ArmModel, frames: Frames, obstacles: Obstacles, contact_stiffness: float, keep: Keep
) -> Contact:
    """Contact at the given link frames; `contact_stiffness` in N/m."""
    axes = (frames.x[:, _FIRST_LINK:], frames.y[:, _FIRST_LINK:], frames.z[:, _FIRST_LINK:])
    start = keep(frames.origin[:, _FIRST_LINK:] + combine(axes, per_link(arm.capsule_start)))
    segment = keep(combine(axes, per_link(arm.capsule_axis)))
    inverse_square = (1.0 / (arm.capsule_axis**2).sum(axis=1))[:, None, None]
    # From here on (3, capsule, sphere, B).
    to_sphere = obstacles.center[:, None] - start[:, :, None]
    share = keep(jnp.clip(dot(to_sphere, segment[:, :, None]) * inverse_square, 0.0, 1.0))
    gap = share[None] * segment[:, :, None] - to_sphere
    square = keep(dot(gap, gap) + 1e-9)  # keeps the derivative finite where axis and centre meet
    inverse_distance = jax.lax.rsqrt(square)
    reach = arm.capsule_radius[:, None, None] + obstacles.radius[None]
    depth = jnp.maximum(reach - square * inverse_distance, 0.0)
    force = contact_stiffness * depth
    on_capsule = keep(gap * keep(force * inverse_distance)[None])
    total = keep(sum_over(on_capsule, 2))
    # Σ (start + share * segment) x force, with the sum taken before any cross product.
    weighted = keep(sum_over(on_capsule * share[None], 2))
    moment = cross(start, total) + cross(segment, weighted)
    return Contact(
        joint_torque=_joint_torque(frames, total, moment, keep),
        link_force=sum_over(force, 1),
        sphere_force=-sum_over(on_capsule, 1),
        touching=sum_over((depth > 0.0).astype(depth.dtype), 0),
    )


def _joint_torque(frames: Frames, force: jax.Array, moment: jax.Array, keep: Keep) -> jax.Array:
    """Torques (7, B) of forces (3, 6, B) on the capsules and their moments about the base, (3, 6, B)."""
    wrench = jnp.concatenate([force, moment])
    nothing = jnp.zeros_like(wrench[:, :_FIRST_LINK])
    beyond = keep(suffix_sum(keep(jnp.concatenate([nothing, wrench], axis=1))))
    return dot(frames.z, beyond[3:] - cross(frames.origin, beyond[:3]))


def pushed(obstacles: Obstacles, contact: Contact, contact_stiffness: float, timestep: float | jax.Array) -> jax.Array:
    """Sphere centres (3, K, B) after `timestep` seconds under the contact and the spring to the rest position.

    A sphere relaxes exponentially towards where contact and spring balance; following that exactly for the stiffness at
    hand keeps any stiffness and damping stable.
    """
    force = contact.sphere_force + obstacles.stiffness * (obstacles.rest - obstacles.center)
    total_stiffness = obstacles.stiffness + contact_stiffness * contact.touching
    relaxed = -jnp.expm1(-timestep * total_stiffness / obstacles.damping)
    return obstacles.center + force * (relaxed / total_stiffness)[None]
