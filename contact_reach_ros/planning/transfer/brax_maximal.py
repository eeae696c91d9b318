"""A Brax system made fit for the pipelines in maximal coordinates, spring and positional.

These move each link on its own and hold the links together by springs, or by moving them back. They know no armature;
it is added to the links' own inertia about the joint axes.
"""

from __future__ import annotations

import dataclasses

import brax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.planning.transfer.model import ArmModel

_FREE = 1e4
"""Stops of joints so far away, in rad, that there are none; positional would not hold the axes without stops."""

_SPRING_RATE = 0.8
"""Rate of the springs that hold links together, times the time step; above 1 is where they become unstable."""


def in_maximal_coordinates(system: brax.System, arm: ArmModel) -> tuple[brax.System, ArmModel]:
    """The system with the arm's armature as inertia of its links, and the arm with the same inertias."""
    tensors = arm.inertia + arm.armature[:, None, None] * np.diag([0.0, 0.0, 1.0])
    moments, axes = np.linalg.eigh(tensors)
    axes = axes * np.linalg.det(axes)[:, None, None]
    inertia = system.link.inertia
    principal, turns = np.array(inertia.i), np.array(inertia.transform.rot)
    principal[-arm.n :] = moments[:, :, None] * np.eye(3)
    turns[-arm.n :] = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    stop = _FREE * jnp.ones(system.qd_size())
    system = system.tree_replace({"link.inertia.i": jnp.asarray(principal), "link.inertia.transform.rot": turns})
    system = system.replace(dof=system.dof.replace(limit=(-stop, stop)))
    return system, dataclasses.replace(arm, inertia=tensors, armature=np.zeros(arm.n))


def with_joint_springs(system: brax.System, arm: ArmModel, timestep: float | jax.Array) -> brax.System:
    """The system with joints of the spring pipeline that are as stiff as a time step, s, permits.

    Brax has one stiffness, N/m and N m/rad, for each joint. The lightest turn of the two links that it joins bounds it.
    Their damping stays zero: that of the joints' offsets makes the arm unstable at any time step.
    """
    least = np.linalg.eigvalsh(arm.inertia)[:, 0]
    inverse = 1.0 / least
    inverse[1:] += 1.0 / least[:-1]
    stiffness = jnp.asarray(system.link.constraint_stiffness).at[-arm.n :].set((_SPRING_RATE / timestep) ** 2 / inverse)
    return system.tree_replace({"link.constraint_stiffness": stiffness})
