"""The mesh of a deformable wall: a box-shaped lattice of nodes and the edges along it."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SceneError
from contact_reach_ros.scenes.scene import Wall, WallSettings

Array = NDArray[np.float64]

MAX_FREE_NODES = 200
"""Nodes of both walls that can move; with more the simulation would not keep its step of 1 ms."""


def make_walls(settings: WallSettings, center: Array) -> tuple[Wall, Wall]:
    """The lower and the upper wall around a gap whose centre is at `center` (3,), m.

    Raises
    ------
    SceneError
        If the mesh has too many nodes, or its nodes overlap or stick out of the walls.
    """
    _check_mesh(settings)
    offset = np.array([0.0, 0.0, 0.5 * (settings.gap + settings.size[2])])
    return _make_wall(settings, center - offset, fixed_level=0), _make_wall(settings, center + offset, fixed_level=-1)


def _check_mesh(settings: WallSettings) -> None:
    along_x, along_y, along_z = settings.nodes
    free = 2 * along_x * along_y * (along_z - 1)
    if free > MAX_FREE_NODES:
        raise SceneError(
            f"wall: nodes = {settings.nodes} has {free} nodes that can move in the two walls; the simulation keeps "
            f"1 kHz with at most {MAX_FREE_NODES}: use a coarser mesh"
        )
    for axis, size, count in zip("xyz", settings.size, settings.nodes, strict=True):
        spacing = (size - 2.0 * settings.node_radius) / (count - 1)
        if spacing < 2.0 * settings.node_radius - 1e-9:
            raise SceneError(
                f"wall: {count} nodes of radius {settings.node_radius:g} m along {axis} do not fit side by side into "
                f"{size:g} m: use fewer or smaller nodes"
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
