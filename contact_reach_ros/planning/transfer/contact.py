"""Soft, frictionless contact between the link capsules and spheres, for all lanes at once.

A capsule and a sphere push each other apart along the line through the sphere's centre and the nearest point of the
capsule's segment, with a force of contact stiffness times penetration. The spheres, alone or joined to deformable
bodies, are a linear network of springs and dampers without mass: D u̇ = f − L u with u their displacements from rest, f
the contact forces and L the stiffness of the network, the same along each axis. Their mass does not matter at the
speeds of this arm.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from contact_reach_ros.planning.transfer.arithmetic import collect, cross, dot, suffix_sum, sum_over
from contact_reach_ros.planning.transfer.dynamics import Frames, place_capsules
from contact_reach_ros.planning.transfer.model import ArmModel

CONTACT_STIFFNESS = 1000.0
"""Force per penetration between a link and a sphere, N/m: that of foam in scenes, where a millimetre is a newton."""

_CONTACT_INSTANT = 0.7
"""Instant at which contact is evaluated, as a share of the step.

At the middle, spheres with much damping would ring. At the end, forces would be 5 % too small, because the spheres have
kept yielding while the arm is taken at the midpoint. In between, forces have no bias.
"""

_TOUCH = 1e-9
"""A negligible depth, m."""


class Obstacles(NamedTuple):
    """Obstacle spheres in the base frame, with their network in modal form: L W = D W diag(rates), Wᵀ D W = I."""

    center: jax.Array
    """(3, K, B), m."""
    rest: jax.Array
    """(3, K, 1), m."""
    radius: jax.Array
    """(K, 1), m."""
    shapes: jax.Array
    """(K, K) W, whose columns are the shapes in which displacements decay."""
    amplitudes: jax.Array
    """(K, K) W⁻¹."""
    rates: jax.Array
    """(K,) rates at which they decay, 1/s."""


class Contact(NamedTuple):
    """Forces between arm and spheres."""

    joint_torque: jax.Array
    """(n, B) on the arm, N m."""
    link_force: jax.Array
    """(L, B) sum over the spheres of the (positive) normal forces on each of the arm's `contact_links`, N."""
    center: jax.Array
    """(3, K, B) sphere centres at the end of the step, m."""


def response(obstacles: Obstacles, timestep: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Relaxation (K, K) and compliance (K, K), m/N: u⁺ = relaxation u + compliance f for a constant force f.

    It is exact over any time, so that stiff networks with little damping need no shorter steps.
    """
    decay = jnp.exp(-timestep * obstacles.rates)
    grown = -jnp.expm1(-timestep * obstacles.rates) / obstacles.rates
    return (obstacles.shapes * decay) @ obstacles.amplitudes, (obstacles.shapes * grown) @ obstacles.shapes.T


def contact_step(
    arm: ArmModel,
    frames: Frames,
    obstacles: Obstacles,
    timestep: float | jax.Array,
) -> Contact:
    """Contact over a step of `timestep` seconds with the links at the given frames.

    The forces are those at a later instant of the step, when the spheres have given way to them: those at its beginning
    would throw light spheres off. A sphere gives way to the forces of all capsules on it, along their sum, and to those
    on the touched spheres that it is joined to, whose shares are estimated from their depths. That is exact where one
    sphere is touched by one capsule, or by several along one line.
    """
    start, segment = place_capsules(arm, frames)
    inverse_square = (1.0 / (arm.capsule_axis**2).sum(axis=1))[:, None, None]
    touched_relaxation, touched_compliance = response(obstacles, _CONTACT_INSTANT * timestep)
    relaxation, compliance = response(obstacles, timestep)
    displacement = obstacles.center - obstacles.rest
    relaxed = obstacles.rest + _joined(touched_relaxation, displacement)
    # From here on (3, capsule, sphere, B).
    to_sphere = relaxed[:, None] - start[:, :, None]
    share = jnp.clip(dot(to_sphere, segment[:, :, None]) * inverse_square, 0.0, 1.0)
    gap = share[None] * segment[:, :, None] - to_sphere
    square = dot(gap, gap) + 1e-9  # keeps the derivative finite where axis and centre meet
    inverse_distance = jax.lax.rsqrt(square)
    reach = arm.capsule_radius[:, None, None] + obstacles.radius[None]
    overlap = reach - square * inverse_distance
    depth = jnp.maximum(overlap, 0.0)
    normal = gap * inverse_distance
    # A sphere yields along the sum of what enters it, away from all capsules that touch it at once.
    along = sum_over(normal * depth, 1)
    entered = jnp.sqrt(dot(along, along) + _TOUCH**2)
    cosine = dot(normal, (along / entered)[:, None])
    stiffness = CONTACT_STIFFNESS * sum_over(jnp.where(depth > 0.0, cosine * cosine, 0.0), 0)
    # How far a sphere yields per force on it, from estimated shares of the force that are corrected once.
    yielding = _joined(touched_compliance, entered[None])[0] / entered
    shares = entered / (1.0 + stiffness * yielding)
    yielding = _joined(touched_compliance, shares[None])[0] / shares
    yielded = entered * (CONTACT_STIFFNESS * yielding / (1.0 + stiffness * yielding))
    # Capsules that it leaves as it yields do not hold it up, others that it comes to do.
    is_held = overlap > cosine * yielded
    entered = sum_over(jnp.where(is_held, cosine * overlap, 0.0), 0)
    stiffness = CONTACT_STIFFNESS * sum_over(jnp.where(is_held, cosine * cosine, 0.0), 0)
    yielded = entered * (CONTACT_STIFFNESS * yielding / (1.0 + stiffness * yielding))
    force = CONTACT_STIFFNESS * jnp.maximum(overlap - cosine * yielded, 0.0)
    on_capsule = normal * force
    total = sum_over(on_capsule, 2)
    # Σ (start + share * segment) x force, with the sum taken before any cross product.
    weighted = sum_over(on_capsule * share[None], 2)
    moment = cross(start, total) + cross(segment, weighted)
    beyond = suffix_sum(collect(jnp.concatenate([total, moment]), arm.capsule_link, arm.n))
    return Contact(
        joint_torque=dot(frames.z, beyond[3:] - cross(frames.origin, beyond[:3])),
        link_force=collect(sum_over(force, 1)[None], arm.capsule_place, len(arm.contact_links))[0],
        center=obstacles.rest + _joined(relaxation, displacement) - _joined(compliance, sum_over(on_capsule, 1)),
    )


def _joined(matrix: jax.Array, values: jax.Array) -> jax.Array:
    """The product (C, K, B) of a matrix (K, K) with values (C, K, B), in the form that fuses."""
    total = matrix[:, 0, None] * values[:, 0][:, None]
    for column in range(1, matrix.shape[1]):
        total = total + matrix[:, column, None] * values[:, column][:, None]
    return total
