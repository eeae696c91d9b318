"""The mesh of a deformable wall: a box-shaped lattice of nodes and the edges along it."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.scene import Wall, WallSettings

Array = NDArray[np.float64]

_STEP = 0.001
"""Of the simulation, s."""

MAX_FREE_NODES = 200
MAX_NODES = 300
"""Nodes of both walls that can move, and of all; with more the simulation would not keep its step of 1 ms: at these
limits it takes up to 0.35 ms in contact (`contact-reach bench foam`)."""


def make_walls(settings: WallSettings, center: Array) -> tuple[Wall, Wall]:
    """The lower and the upper wall around a gap whose centre is at `center` (3,), m.

    Raises
    ------
    SceneError
        As `check_mesh`.
    """
    check_mesh(settings)
    offset = np.array([0.0, 0.0, 0.5 * (settings.gap + settings.size[2])])
    return _make_wall(settings, center - offset, fixed_level=0), _make_wall(settings, center + offset, fixed_level=-1)


def check_mesh(settings: WallSettings) -> None:
    """Refuse a mesh that cannot be simulated.

    Raises
    ------
    SceneError
        If it has too many nodes, its springs are too stiff for the nodes' mass, or the nodes overlap.
    """
    along_x, along_y, along_z = settings.nodes
    count, free = 2 * along_x * along_y * along_z, 2 * along_x * along_y * (along_z - 1)
    if free > MAX_FREE_NODES or count > MAX_NODES:
        raise SceneError(
            f"wall: nodes = {settings.nodes} makes {count} nodes in the two walls, {free} of which can move; the "
            f"simulation keeps 1 kHz with at most {MAX_NODES} and {MAX_FREE_NODES}: use a coarser mesh"
        )
    # The eigenvalues of the mesh are at most twice what the edges of one node add up to (Gershgorin).
    edges = sum(min(number - 1, 2) for number in settings.nodes)
    stiffness = 2.0 * edges * settings.edge_stiffness + settings.anchor_stiffness + settings.contact_stiffness
    check_stiffness("wall", stiffness, settings.node_mass)
    for axis, size, count in zip("xyz", settings.size, settings.nodes, strict=True):
        spacing = (size - 2.0 * settings.node_radius) / (count - 1)
        if spacing < 2.0 * settings.node_radius - 1e-9:
            raise SceneError(
                f"wall: {count} nodes of radius {settings.node_radius:g} m along {axis} do not fit side by side into "
                f"{size:g} m: use fewer or smaller nodes"
            )


def check_stiffness(section: str, stiffness: float, mass: float) -> None:
    """Refuse springs and contact of `stiffness` N/m that a simulation in steps of 1 ms cannot hold on `mass` kg.

    Semi-implicit Euler steps are stable up to 4 m / dt²; half of that leaves room for hardening and mismatch.

    Raises
    ------
    SceneError
        With the greatest stiffness.
    """
    limit = 2.0 * mass / _STEP**2
    if stiffness > limit:
        raise SceneError(
            f"{section}: springs and contact of {stiffness:g} N/m in all on {mass:g} kg; the simulation in steps of "
            f"1 ms is stable up to {limit:g} N/m: use softer foam or more mass"
        )


def _make_wall(settings: WallSettings, center: Array, fixed_level: int) -> Wall:
    # Inset by the radius, so that the surfaces of the outer nodes are where those of the wall are.
    extents = 0.5 * np.array(settings.size) - settings.node_radius
    axes = [np.linspace(-extent, extent, count) for extent, count in zip(extents, settings.nodes, strict=True)]
    rest = center + np.array(list(itertools.product(*axes)))
    index = np.arange(len(rest)).reshape(settings.nodes)
    edges = []
    for axis in range(3):
        along = np.moveaxis(index, axis, 0)
        edges.append(np.stack([along[:-1].ravel(), along[1:].ravel()], axis=1))
    fixed = np.zeros(settings.nodes, bool)
    fixed[:, :, fixed_level] = True
    return Wall(rest, np.concatenate(edges), fixed.ravel(), settings)
