"""How far the arm is from the obstacles, for many postures at once."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.obstacles import nearest_bodies
from contact_reach_ros.planning.paths import levers
from contact_reach_ros.planning.transfer.arithmetic import dot, single
from contact_reach_ros.planning.transfer.clearance import Bodies, intrusions
from contact_reach_ros.planning.transfer.dynamics import link_frames, place_capsules
from contact_reach_ros.planning.transfer.model import arm_model
from contact_reach_ros.world.collision import nearest
from contact_reach_ros.world.spheres import Spheres

_LANES = 64
"""Postures that one call of the compiled programs looks at."""


class ClearanceChecker:
    """Decides which postures and motions of an arm keep clear of obstacles and of the arm itself.

    Parameters
    ----------
    spheres
        Obstacles, where they are now, with the rigid bodies.
    clearance
        Least distance between a link and a sphere, m. A pair that is nearer in the posture `start` may stay as near.
        From rigid bodies and other links it is half the resolution, so that nothing touches in between.
    resolution
        Along a motion, no point of the arm moves by more than this from one posture that is checked to the next, m.
        In between, the distance may be smaller than the clearance by half of that.
    start
        (n,) joint angles where motions begin, rad.

    Raises
    ------
    PlanningError
        If the arm touches a sphere at the start.
    """

    def __init__(self, arm: Arm, spheres: Spheres, clearance: float, resolution: float, start: Array) -> None:
        self.arm = arm
        self._count = len(spheres)
        self._resolution = resolution
        self._centers, self._radii = single(spheres.center.T[:, :, None]), single(spheres.radius[:, None])
        self._required = single(np.zeros((len(arm.capsules), self._count, 1)))
        self._bodies = nearest_bodies(arm, start, spheres.environment)
        at_start = [pair.distance for pair in nearest(arm, start[None], spheres.environment)]
        self._margin = max(0.0, min([0.5 * resolution, *at_start]) - 1e-6)
        self._is_empty = not self._count and not spheres.environment
        if self._count:
            apart = np.asarray(distances(arm, single(start[:, None]), self._centers, self._radii))
            if apart.min() < 0.0:
                raise PlanningError(
                    f"the arm is {-1e3 * apart.min():.1f} mm deep in an obstacle at q = "
                    f"{np.round(start, 3).tolist()}: a collision-free path starts without contact; withdraw the arm "
                    "first"
                )
            # Less a rounding error of single precision.
            self._required = single(np.minimum(clearance, apart) - 1e-6)

    def distances(self, postures: Array) -> Array:
        """Smallest distance (N,) between a link and a sphere at the postures (N, n), m; negative is depth."""
        if not self._count or not len(postures):
            return np.full(len(postures), np.inf)
        nearest = [_nearest(self.arm, chunk, self._centers, self._radii) for chunk in _chunks(postures)]
        return np.concatenate([np.asarray(chunk, float) for chunk in nearest])[: len(postures)]

    def free(self, postures: Array) -> NDArray[np.bool_]:
        """(N,) whether the postures (N, n) keep clear."""
        if self._is_empty or not len(postures):
            return np.ones(len(postures), bool)
        clear = [self._clear(chunk) for chunk in _chunks(postures)]
        return np.concatenate([np.asarray(chunk) for chunk in clear])[: len(postures)]

    def motion_free(self, start: Array, end: Array) -> bool:
        """Whether the straight motion in joint space between two postures (n,), ends included, keeps clear."""
        if self._is_empty:
            return True
        count = 1 + max(1, int(np.ceil(np.abs(end - start) @ levers(self.arm) / self._resolution)))
        shares = np.linspace(0.0, 1.0, count)
        calls = -(-count // _LANES)
        # Each call looks at the whole motion, coarsely: most motions that collide are found out by the first.
        for call in range(calls):
            chunk = np.ones(_LANES)
            own = shares[call::calls]
            chunk[: len(own)] = own
            postures = start[:, None] + chunk * (end - start)[:, None]
            if not np.asarray(self._clear(single(postures))).all():
                return False
        return True

    def _clear(self, postures: jax.Array) -> jax.Array:
        """(B,) whether the postures (n, B) keep clear."""
        spheres = (self._centers, self._radii, self._required)
        return _clear(self.arm, postures, *spheres, self._bodies, self._margin)


def _chunks(postures: Array) -> list[jax.Array]:
    """Postures (N, n) in pieces (n, `_LANES`), the last one filled up with its last posture."""
    missing = -len(postures) % _LANES
    padded = np.concatenate([postures, np.repeat(postures[-1:], missing, axis=0)])
    return [single(chunk.T) for chunk in padded.reshape(-1, _LANES, postures.shape[1])] if len(postures) else []


@functools.partial(jax.jit, static_argnums=0)
def distances(table: Arm, postures: jax.Array, centers: jax.Array, radii: jax.Array) -> jax.Array:
    """Distances (C, K, B) of spheres with centres (3, K, 1) and radii (K, 1) from the capsules at postures (n, B)."""
    arm = arm_model(table)
    frames = link_frames(arm, postures)
    start, segment = place_capsules(arm, frames)
    inverse_square = (1.0 / (arm.capsule_axis**2).sum(axis=1))[:, None, None]
    to_sphere = centers[:, None] - start[:, :, None]
    share = jnp.clip(dot(to_sphere, segment[:, :, None]) * inverse_square, 0.0, 1.0)
    gap = to_sphere - share[None] * segment[:, :, None]
    return jnp.sqrt(dot(gap, gap)) - arm.capsule_radius[:, None, None] - radii[None]


@functools.partial(jax.jit, static_argnums=0)
def _nearest(arm: Arm, postures: jax.Array, centers: jax.Array, radii: jax.Array) -> jax.Array:
    return distances(arm, postures, centers, radii).min(axis=(0, 1))


@functools.partial(jax.jit, static_argnums=0)
def _clear(
    table: Arm,
    postures: jax.Array,
    centers: jax.Array,
    radii: jax.Array,
    required: jax.Array,
    bodies: Bodies,
    margin: jax.Array,
) -> jax.Array:
    arm = arm_model(table)
    apart = (distances(table, postures, centers, radii) >= required).all(axis=(0, 1))
    capsules = place_capsules(arm, link_frames(arm, postures))
    own, others = intrusions(arm, capsules, bodies, margin)
    return apart & (own + others == 0.0)
