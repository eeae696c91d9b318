"""Mass matrix and Jacobian of all lanes, with every spatial quantity taken about the flange.

With the flange as the one reference point the joints' motion vectors are the columns of the Jacobian, and composite
inertias are plain sums.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.planning.transfer.kinematics import Frames
from contact_reach_ros.planning.transfer.lanes import Keep, combine, cross, cycled, dot, per_link, suffix_sum
from contact_reach_ros.planning.transfer.model import ArmModel


CYCLES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


class Dynamics(NamedTuple):
    """What law (3) and the equation of motion need of the arm."""

    jacobian: jax.Array
    """(6, 7, B): linear then angular velocity of the flange, base axes."""
    mass_matrix: jax.Array
    """(7, 7, B), kg m², armature included; only entries [i, j] with i ≤ j are valid."""


def arm_dynamics(arm: ArmModel, frames: Frames, keep: Keep) -> Dynamics:
    """Jacobian and mass matrix at the given frames, by the composite-rigid-body algorithm."""
    axis = keep(frames.z)
    jacobian = keep(jnp.concatenate([cross(axis, frames.flange[:, None] - frames.origin), axis]))
    first, diagonal, products = _composite_inertias(arm, frames, keep)
    composite_mass = np.cumsum(arm.mass[::-1])[::-1][:, None]
    # Momentum of everything beyond a joint when that joint alone turns at unit speed.
    velocity = jacobian[:3]
    linear = [
        keep(velocity[a] * composite_mass + axis[b] * first[c] - axis[c] * first[b]) for a, b, c in CYCLES
    ]
    # Row a of the inertia tensor: its moment and the products with b and c.
    angular = [
        keep(
            first[b] * velocity[c] - first[c] * velocity[b]
            + diagonal[a] * axis[a] + products[c] * axis[b] + products[b] * axis[c]
        )
        for a, b, c in CYCLES
    ]
    momentum = [*linear, *angular]
    # Outer products summed in this form are 20 times faster than a contraction.
    mass_matrix = jacobian[0][:, None] * momentum[0][None]
    for row in range(1, 6):
        mass_matrix = mass_matrix + jacobian[row][:, None] * momentum[row][None]
    return Dynamics(jacobian, mass_matrix + np.diag(arm.armature)[:, :, None])


def _composite_inertias(arm: ArmModel, frames: Frames, keep: Keep) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First moment, moments (xx, yy, zz) and products (yz, zx, xy) of the links from each one on, each (3, 7, B)."""
    axes = (frames.x, frames.y, frames.z)
    center = keep(frames.origin + combine(axes, per_link(arm.center_of_mass)) - frames.flange[:, None])
    mass = arm.mass[:, None]
    first = keep(center * mass)
    diagonal = dot(first, center)[None] - first * center
    products = [-first[a] * center[b] for a, b in ((1, 2), (2, 0), (0, 1))]
    # Σ_ab I_ab axis_a axis_bᵀ, the inertia about the centre of mass in base axes.
    for index, axis in enumerate(axes):
        tensor_axis = combine(axes, per_link(arm.inertia[:, index]))
        diagonal = diagonal + tensor_axis * axis
        products = [
            product + tensor_axis[a] * axis[b] for product, (a, b) in zip(products, ((1, 2), (2, 0), (0, 1)))
        ]
    composite = [keep(suffix_sum(keep(part))) for part in (first, diagonal, jnp.stack([keep(x) for x in products]))]
    return composite
