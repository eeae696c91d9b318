"""How far the arm is from the obstacles, for many postures at once.

As in the rest of the package, the arm touches obstacles only: neither itself nor its own base.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.planning.transfer.kinematics import link_frames
from contact_reach_ros.planning.transfer.lanes import combine, dot, make_keep, per_link, single
from contact_reach_ros.planning.transfer.model import N_CAPSULES, N_LINKS, default_arm
from contact_reach_ros.robot import iiwa14

Array = NDArray[np.float64]

_LANES = 64
"""Postures that one call of the compiled programs looks at."""


def _levers() -> Array:
    offsets = np.array([joint.offset for joint in iiwa14.JOINTS])
    last = iiwa14.CAPSULES[-1]
    # The origin of the next joint only turns with this one as far as it lies beside this one's axis.
    beside = np.append(np.linalg.norm(offsets[1:, :2], axis=1), 0.0)
    lengths = np.append(np.linalg.norm(offsets[1:], axis=1), 0.0)
    beyond = np.array([lengths[joint + 1 :].sum() for joint in range(iiwa14.N_JOINTS)])
    return beside + beyond + float(np.linalg.norm(last.end)) + max(capsule.radius for capsule in iiwa14.CAPSULES)


LEVERS = _levers()
"""(7,) m: turning joint i by an angle moves no point of the arm by more than that angle times LEVERS[i]."""


class ClearanceChecker:
    """Tells postures and motions that keep clear of obstacle spheres from those that do not.

    Parameters
    ----------
    spheres
        Obstacles, where they are now.
    clearance
        Least distance between a link and a sphere, m. A pair that is nearer in the posture `start` may stay as near.
    resolution
        Along a motion, no point of the arm moves by more than this from one posture that is checked to the next, m.
        In between, the distance may be smaller than the clearance by half of that.
    start
        (7,) joint angles where motions begin, rad.

    Raises
    ------
    PlanningError
        If the arm touches a sphere at the start.
    """

    def __init__(self, spheres: Spheres, clearance: float, resolution: float, start: Array) -> None:
        self._count = len(spheres)
        self._resolution = resolution
        self._centers, self._radii = single(spheres.center.T[:, :, None]), single(spheres.radius[:, None])
        self._required = single(np.zeros((N_CAPSULES, self._count, 1)))
        if self._count:
            at_start = np.asarray(_distances(single(start[:, None]), self._centers, self._radii))
            if at_start.min() < 0.0:
                raise PlanningError(
                    f"the arm is {-1e3 * at_start.min():.1f} mm deep in an obstacle at q = "
                    f"{np.round(start, 3).tolist()}: a collision-free path starts without contact; withdraw the arm "
                    "first"
                )
            # Less a rounding error of single precision.
            self._required = single(np.minimum(clearance, at_start) - 1e-6)

    def distances(self, postures: Array) -> Array:
        """Smallest distance (N,) between a link and a sphere at the postures (N, 7), m; negative is depth."""
        if not self._count:
            return np.full(len(postures), np.inf)
        nearest = [_nearest(chunk, self._centers, self._radii) for chunk in _chunks(postures)]
        return np.concatenate([np.asarray(chunk, float) for chunk in nearest])[: len(postures)]

    def free(self, postures: Array) -> NDArray[np.bool_]:
        """(N,) whether the postures (N, 7) keep clear."""
        if not self._count:
            return np.ones(len(postures), bool)
        clear = [_clear(chunk, self._centers, self._radii, self._required) for chunk in _chunks(postures)]
        return np.concatenate([np.asarray(chunk) for chunk in clear])[: len(postures)]

    def motion_free(self, start: Array, end: Array) -> bool:
        """Whether the straight motion in joint space between two postures (7,), ends included, keeps clear."""
        if not self._count:
            return True
        count = 1 + max(1, int(np.ceil(np.abs(end - start) @ LEVERS / self._resolution)))
        shares = np.linspace(0.0, 1.0, count)
        calls = -(-count // _LANES)
        # Each call looks at the whole motion, coarsely: most motions that collide are found out by the first.
        for call in range(calls):
            chunk = np.ones(_LANES)
            own = shares[call::calls]
            chunk[: len(own)] = own
            postures = start[:, None] + chunk * (end - start)[:, None]
            if not np.asarray(_clear(single(postures), self._centers, self._radii, self._required)).all():
                return False
        return True


def _chunks(postures: Array) -> list[jax.Array]:
    """Postures (N, 7) in pieces (7, `_LANES`), the last one filled up with its last posture."""
    missing = -len(postures) % _LANES
    padded = np.concatenate([postures, np.repeat(postures[-1:], missing, axis=0)])
    return [single(chunk.T) for chunk in padded.reshape(-1, _LANES, iiwa14.N_JOINTS)] if len(postures) else []


@jax.jit
def _distances(postures: jax.Array, centers: jax.Array, radii: jax.Array) -> jax.Array:
    """Distances (6, K, B) of spheres with centres (3, K, 1) and radii (K, 1) from the links at postures (7, B)."""
    arm = default_arm()
    keep = make_keep(postures)
    frames = link_frames(arm, postures, keep)
    first = N_LINKS - N_CAPSULES  # one capsule on each of the last links, in order
    axes = (frames.x[:, first:], frames.y[:, first:], frames.z[:, first:])
    start = keep(frames.origin[:, first:] + combine(axes, per_link(arm.capsule_start)))
    segment = keep(combine(axes, per_link(arm.capsule_axis)))
    inverse_square = (1.0 / (arm.capsule_axis**2).sum(axis=1))[:, None, None]
    to_sphere = centers[:, None] - start[:, :, None]
    share = jnp.clip(dot(to_sphere, segment[:, :, None]) * inverse_square, 0.0, 1.0)
    gap = to_sphere - share[None] * segment[:, :, None]
    return jnp.sqrt(dot(gap, gap)) - arm.capsule_radius[:, None, None] - radii[None]


@jax.jit
def _nearest(postures: jax.Array, centers: jax.Array, radii: jax.Array) -> jax.Array:
    return _distances(postures, centers, radii).min(axis=(0, 1))


@jax.jit
def _clear(postures: jax.Array, centers: jax.Array, radii: jax.Array, required: jax.Array) -> jax.Array:
    return (_distances(postures, centers, radii) >= required).all(axis=(0, 1))
