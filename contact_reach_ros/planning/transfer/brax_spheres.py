"""Obstacle spheres as bodies of a Brax system: each moves on three sliders.

Their springs and dampers are those of the sliders. Where spheres are joined to one another, two custom fields of the
MJCF hold the matrices L and D of the network instead, row by row; Brax's own pipelines do not know these.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from contact_reach_ros.arm.mjcf import OBSTACLE_CONTACT_TYPE, ROBOT_CONTACT_TYPE, numbers
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import custom_field

if TYPE_CHECKING:
    import brax

NETWORK_STIFFNESS, NETWORK_DAMPING = "network_stiffness", "network_damping"
"""Custom fields with the matrices (K, K) of spheres that are joined, N/m and N s/m."""

_SPHERE = 2
"""MuJoCo's number of this type of geometry."""

_IMPEDANCE = 0.9
_FRICTION = 0.2
_CONTACT_DAMPING = 10.0
"""N s/m."""


def sphere_body(
    index: int,
    rest: Iterable[float] = (0.0, 0.0, 0.0),
    radius: float = 0.1,
    stiffness: float = 0.0,
    damping: float = 0.0,
) -> Element:
    """A sphere at `rest` (3,), m, with spring, N/m, and damper, N s/m."""
    body = Element("body", name=f"sphere_{index}", pos=numbers(rest))
    for axis in ("1 0 0", "0 1 0", "0 0 1"):
        SubElement(body, "joint", type="slide", axis=axis, stiffness=repr(stiffness), damping=repr(damping))
    SubElement(
        body,
        "geom",
        type="sphere",
        size=repr(radius),
        mass="0.1",
        contype=str(OBSTACLE_CONTACT_TYPE),
        conaffinity=str(ROBOT_CONTACT_TYPE),
    )
    return body


def bodies_and_fields(obstacles: Obstacles | None) -> tuple[list[Element], dict[str, list[float]]]:
    """What an MJCF has of obstacles with one lane: bodies, and fields where spheres are joined."""
    if obstacles is None:
        return [], {}
    obstacles = jax.tree.map(lambda values: np.asarray(values, np.float64), obstacles)
    stiffness, damping = (np.asarray(matrix) for matrix in network(obstacles))
    alone = not (_off_diagonal(stiffness) or _off_diagonal(damping))
    rest, radius = obstacles.rest[..., 0].T, obstacles.radius[:, 0]
    springs = np.stack([np.diag(stiffness), np.diag(damping)], axis=1) if alone else np.zeros((len(radius), 2))
    bodies = [
        sphere_body(index, rest[index], float(radius[index]), float(spring), float(damper))
        for index, (spring, damper) in enumerate(springs)
    ]
    fields = {NETWORK_STIFFNESS: stiffness.ravel().tolist(), NETWORK_DAMPING: damping.ravel().tolist()}
    return bodies, {} if alone else fields


def network(obstacles: Obstacles) -> tuple[jax.Array, jax.Array]:
    """Stiffness and damping matrices (K, K) of the spheres: L = W⁻ᵀ diag(rates) W⁻¹ and D = W⁻ᵀ W⁻¹."""
    amplitudes = obstacles.amplitudes
    return amplitudes.T @ (obstacles.rates[:, None] * amplitudes), amplitudes.T @ amplitudes


def _off_diagonal(matrix: Array) -> bool:
    return bool(np.abs(matrix - np.diag(np.diag(matrix))).max() > 1e-6 * np.abs(matrix).max())


def read_spheres(system: brax.System) -> Obstacles | None:
    """The spheres of a system, at rest and with one lane; None if there are none.

    Raises
    ------
    SettingsError
        If a sphere is not held by springs and dampers, or is no sphere on three sliders.
    """
    links = np.flatnonzero([kind == "3" for kind in system.link_types])
    if not len(links):
        return None
    model = system.mj_model
    geoms = np.array([int(np.argmax(model.geom_bodyid == link + 1)) for link in links])
    dofs = np.array([system.dof_ranges()[link] for link in links])
    if (
        not np.array_equal(model.geom_bodyid[geoms], links + 1)
        or np.any(model.geom_type[geoms] != _SPHERE)
        or np.any(np.asarray(system.dof.motion.vel)[dofs] != np.eye(3))
    ):
        names = [system.link_names[link] for link in links]
        raise SettingsError(f"links {names}: expected spheres on sliders along x, y and z, one geometry each")
    size = len(links) ** 2
    stiffness, damping = (
        np.diag(np.asarray(values, float)[dofs[:, 0]]) if given is None else given.reshape(len(links), -1)
        for values, given in (
            (system.dof.stiffness, custom_field(system, NETWORK_STIFFNESS, size)),
            (system.dof.damping, custom_field(system, NETWORK_DAMPING, size)),
        )
    )
    if min(np.linalg.eigvalsh(stiffness)[0], np.linalg.eigvalsh(damping)[0]) <= 0.0:
        raise SettingsError("expected a spring and a damper for each sphere: give its sliders stiffness and damping")
    rates, shapes = scipy.linalg.eigh(stiffness, damping)
    rest = np.asarray(system.link.transform.pos)[links].T[:, :, None]
    return Obstacles(
        center=single(rest),
        rest=single(rest),
        radius=single(np.asarray(system.geom_size)[geoms, :1]),
        shapes=single(shapes),
        amplitudes=single(shapes.T @ damping),
        rates=single(rates),
    )


def with_spheres(system: brax.System, obstacles: Obstacles, mass: jax.Array, contact_stiffness: float) -> brax.System:
    """Put the spheres of a problem into a system: positions, sizes, masses and the stiffness of contact with them."""
    count = len(mass)
    link = system.link
    # MuJoCo's soft contact scales its stiffness by the inverse masses and by (1 - d), and a friction pyramid has four
    # edges that share the normal force.
    pyramid = 0.5 * _FRICTION**2 * (1.0 + _FRICTION**2)
    scale = (1.0 - _IMPEDANCE) * pyramid / mass
    solref = jnp.stack([-contact_stiffness * scale, -_CONTACT_DAMPING * scale], axis=1)
    spheres = jnp.flatnonzero(np.asarray(system.geom_type) == _SPHERE, size=count)
    return system.tree_replace(
        {
            "link.transform.pos": jnp.asarray(link.transform.pos).at[:count].set(obstacles.rest[:, :, 0].T),
            "link.inertia.mass": jnp.asarray(link.inertia.mass).at[:count].set(mass),
            "link.invweight": jnp.zeros_like(link.invweight).at[:count].set(1.0 / mass),
            "geom_size": jnp.asarray(system.geom_size).at[spheres, 0].set(obstacles.radius[:, 0]),
            # Of two geometries, MuJoCo takes the smaller reference, the larger friction and the mean impedance.
            "geom_solref": jnp.asarray(system.geom_solref).at[spheres].set(solref),
            "geom_friction": jnp.asarray(system.geom_friction).at[:, 0].set(_FRICTION),
            "geom_solimp": jnp.asarray(system.geom_solimp).at[:, :2].set(_IMPEDANCE),
        }
    )
