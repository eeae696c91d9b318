"""Obstacles in the form that compiled programs take, and the refusal of motions that run into rigid bodies."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.errors import InputError, PlanningError
from contact_reach_ros.planning.transfer.arithmetic import single
from contact_reach_ros.planning.transfer.clearance import Bodies
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.world.collision import (
    capsule_segments,
    clearances,
    nearest,
    nearest_of,
)
from contact_reach_ros.world.rigid import Block, Environment, Plane
from contact_reach_ros.world.spheres import Spheres

_FAR_AWAY = (0.0, 0.0, -100.0)
"""Position of the spheres that fill up the capacity, m: out of reach, but near enough for single precision."""


class ObstacleReader:
    """Converts obstacle spheres into the form of the transfer model; for use from one thread.

    Only the spheres nearest to the arm are kept. The spheres joined to them are condensed away: free of contact forces,
    they follow the kept ones, and the remaining network has exactly the stiffness that the kept spheres feel (static
    condensation, Guyan 1965).

    Parameters
    ----------
    arm
        Arm that may touch the spheres.
    capacity
        Number of spheres that the transfer model is compiled for; it is filled up with spheres out of reach.

    Raises
    ------
    InputError
        If the number is below zero.
    """

    def __init__(self, arm: Arm, capacity: int) -> None:
        if capacity < 0:
            raise InputError(f"a capacity of {capacity} spheres; expected 0, which compiles no contact, or more")
        self._arm = arm
        self._capacity = capacity
        self._network: Network | None = None
        self._kept: NDArray[np.intp] = np.zeros(0, np.intp)
        self._modes: tuple[Array, Array, Array] | None = None

    def read(self, q: Array, spheres: Spheres) -> Obstacles | None:
        """Convert the spheres for the transfer model, with one lane; None for a model without obstacles.

        Parameters
        ----------
        q
            (n,) joint angles, rad, at which the nearest spheres are chosen.
        spheres
            Any number of them.
        """
        count = len(spheres)
        if self._capacity == 0:
            return None
        kept = np.arange(count)
        if count > self._capacity:
            apart = clearances(self._arm, q, spheres)
            near = np.flatnonzero(apart <= np.partition(apart, self._capacity - 1)[self._capacity - 1])
            # Sorted, so that a sphere keeps its index for as long as it is kept.
            kept = np.sort(near[np.argsort(apart[near], kind="stable")[: self._capacity]])
        if self._network is None or not self._network.same_as(spheres):
            self._network, self._modes = Network(spheres), None
        if self._modes is None or not np.array_equal(kept, self._kept):
            self._kept, self._modes = kept, self._network.modes(kept, self._capacity)
        missing, (shapes, amplitudes, rates) = self._capacity - len(kept), map(single, self._modes)
        far_away = np.tile(_FAR_AWAY, (missing, 1))

        def points(values: Array) -> jax.Array:
            return single(np.concatenate([values[kept], far_away]).T[:, :, None])

        return Obstacles(
            center=points(spheres.center),
            rest=points(spheres.rest),
            radius=single(np.concatenate([spheres.radius[kept], np.zeros(missing)])[:, None]),
            shapes=shapes,
            amplitudes=amplitudes,
            rates=rates,
        )


class Network:
    """The springs and dampers of spheres: D u̇ = f − L u along each axis."""

    def __init__(self, spheres: Spheres) -> None:
        self._spheres = spheres
        joined, ends = np.unique(spheres.edges, return_inverse=True)
        stiffness = np.diag(spheres.stiffness[joined])
        first, second = ends.reshape(-1, 2).T
        for one, other, sign in ((first, first, 1), (second, second, 1), (first, second, -1), (second, first, -1)):
            np.add.at(stiffness, (one, other), sign * spheres.edge_stiffness)
        self._joined, self._compliance = joined, np.linalg.inv(stiffness)
        self.softness = np.zeros(len(spheres))
        """(K,) displacement of each sphere under a force on itself alone, m/N."""
        self.softness[joined] = np.diag(self._compliance)
        np.divide(1.0, spheres.stiffness, out=self.softness, where=self.softness == 0.0)

    def compliance(self, moved: NDArray[np.intp], pushed: NDArray[np.intp]) -> Array:
        """Part (M, P) of L⁻¹, m/N: displacements of the spheres `moved` (M,) under forces on `pushed` (P,)."""
        part = (moved[:, None] == pushed) * self.softness[pushed]
        rows, columns = np.isin(moved, self._joined), np.isin(pushed, self._joined)
        places = (np.searchsorted(self._joined, each) for each in (moved[rows], pushed[columns]))
        part[np.ix_(rows, columns)] = self._compliance[np.ix_(*places)]
        return part

    def same_as(self, spheres: Spheres) -> bool:
        """Whether the spheres, wherever they are, form this network."""
        return self._spheres is spheres or all(
            np.array_equal(getattr(self._spheres, name), getattr(spheres, name))
            for name in ("stiffness", "damping", "edges", "edge_stiffness")
        )

    def modes(self, kept: NDArray[np.intp], capacity: int) -> tuple[Array, Array, Array]:
        """Modes of the network condensed to the spheres `kept`, filled up to `capacity` with unconnected spheres.

        Shapes W (K, K) in which displacements decay, W⁻¹ (K, K), and the rates (K,) of the decay, 1/s.
        """
        # Displacement of all spheres when the kept ones are displaced and forces act on those alone.
        stiffness = np.linalg.inv(self.compliance(kept, kept))
        moved = np.union1d(kept, self._joined)
        followers = self.compliance(moved, kept) @ stiffness
        damping = followers.T @ (self._spheres.damping[moved, None] * followers)
        # K φ = λ D φ by the eigenvectors of L⁻¹ K L⁻ᵀ, where D = L Lᵀ.
        unloaded = np.linalg.inv(np.linalg.cholesky(0.5 * (damping + damping.T)))
        scaled = unloaded @ stiffness @ unloaded.T
        rates, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
        shapes, amplitudes, count = np.eye(capacity), np.eye(capacity), len(kept)
        shapes[:count, :count] = unloaded.T @ vectors
        amplitudes[:count, :count] = shapes[:count, :count].T @ damping
        return shapes, amplitudes, np.concatenate([rates, np.ones(capacity - count)])


PLANES, BLOCKS = 2, 2
"""How many bodies of each kind the cost of a plan takes into account: the nearest ones."""
_AWAY = 100.0
"""How far away the bodies are that fill up these numbers, m: out of reach, near enough for single precision."""
LEAST_CLEARANCE, LEAST_OWN = 0.002, -0.002
"""Distance from rigid bodies below which a motion is refused, m: more than the error of its prediction; and that of the
arm's own capsules, which are rounder than links."""
_NEARER = 2e-4
"""By how much a motion that begins nearer may go nearer still, m."""


def nearest_bodies(arm: Arm, q: Array, environment: Environment) -> Bodies:
    """The bodies nearest to the arm at joint angles `q` (n,), rad, as compiled programs take them."""
    segments = capsule_segments(arm, q)
    planes = nearest_of(tuple(body for body in environment if isinstance(body, Plane)), PLANES, *segments)
    blocks = nearest_of(tuple(body for body in environment if isinstance(body, Block)), BLOCKS, *segments)
    planes += (Plane("", (0.0, 0.0, -_AWAY)),) * (PLANES - len(planes))
    blocks += (Block("", (0.0, 0.0, -_AWAY), (1.0, 1.0, 1.0)),) * (BLOCKS - len(blocks))
    return Bodies(
        normal=single(np.array([plane.normal for plane in planes]).T[:, :, None]),
        offset=single(np.array([plane.offset for plane in planes])[:, None]),
        center=single(np.array([block.center for block in blocks]).T[:, :, None]),
        axes=single(np.array([block.axes.T for block in blocks]).transpose(1, 2, 0)[..., None]),
        half=single(np.array([block.half for block in blocks]).T[:, :, None]),
    )


def check_motion(arm: Arm, q: Array, environment: Environment) -> None:
    """Refuse a motion through postures `q` (N, n), rad, that brings the arm to a rigid body or to itself.

    Where it begins nearer, it has to lead away.

    Raises
    ------
    PlanningError
        If a posture after the first is nearer than `LEAST_CLEARANCE`, or to itself `LEAST_OWN`, and nearer than the
        first; it has the numbers.
    """
    others, own = nearest(arm, q, environment, itself=False), nearest(arm, q, ())
    for pairs, least in ((others, LEAST_CLEARANCE), (own, LEAST_OWN)):
        if not pairs:
            continue
        first, *later = pairs
        closest = min(later, key=lambda pair: pair.distance)
        if closest.distance < min(least, first.distance - _NEARER):
            raise PlanningError(
                f"the plan would bring the arm into a collision: {closest}, expected {1000 * least:g} mm or more "
                "between them; it is refused and the plan in force runs out into a hold: choose another goal or "
                "posture, or move the body"
            )
