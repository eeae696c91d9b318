"""Displacement of a wall's pressed node: in the simulation, and in the planner's linear model of the mesh."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.spheres import Spheres


def press_in_plant(plant: Plant, node: int, force: Array, steps: int) -> Array:
    """Displacement of one obstacle sphere under a constant force, (steps, 3), m, after each step of 1 ms.

    Parameters
    ----------
    plant
        Plant at rest; it is left pressed.
    node
        Index in `Plant.obstacle_positions`.
    force
        (3,), N.
    steps
        Number of steps.
    """
    # The spheres' bodies are the last ones.
    positions = plant.obstacle_positions()
    body, before = plant.model.nbody - len(positions) + node, positions[node]
    plant.data.xfrc_applied[body, :3] = force
    track = np.empty((steps, 3))
    for step in range(steps):
        plant.step()
        track[step] = plant.obstacle_positions()[node] - before
    return track


def press_in_model(spheres: Spheres, node: int, force: Array, times: Array) -> Array:
    """Displacement in the planner's model, damping · du/dt = f - L u from rest, (len(times), 3), m.

    L is the Laplacian of the edges plus the springs of the spheres. `times` are in s; infinity gives the limit.
    """
    stiffness = stiffness_matrix(spheres)
    scale = 1.0 / np.sqrt(spheres.damping)
    rates, modes = np.linalg.eigh(scale[:, None] * stiffness * scale)
    load = modes.T @ (scale * (np.arange(len(spheres)) == node))
    growth = -np.expm1(-np.outer(times, rates)) / rates
    return np.outer(scale[node] * (growth * load) @ modes[node], force)


def stiffness_matrix(spheres: Spheres) -> Array:
    """Stiffness matrix L, (K, K), N/m, the same for each axis."""
    matrix = np.diag(spheres.stiffness)
    for (start, end), stiffness in zip(spheres.edges, spheres.edge_stiffness, strict=True):
        matrix[start, start] += stiffness
        matrix[end, end] += stiffness
        matrix[start, end] -= stiffness
        matrix[end, start] -= stiffness
    return matrix


def lattice(obstacle: Obstacle) -> tuple[int, ...]:
    """Numbers of nodes of a mesh along x, y and z, of which z counts fastest."""
    return tuple(len(np.unique(np.round(places, 6))) for places in obstacle.rest.T)
