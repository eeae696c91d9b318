"""Rigid bodies in plans: those that a compiled program looks at, and the refusal of motions that run into any."""

from __future__ import annotations

import functools

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsules import shape_segments
from contact_reach_ros.errors import PlanningError
from contact_reach_ros.planning.transfer.clearance import Bodies, bodies_of
from contact_reach_ros.world.collision import body_distances, nearest
from contact_reach_ros.world.rigid import Block, Environment, Plane, RigidBody

PLANES, BLOCKS = 2, 2
"""How many bodies of each kind the cost of a plan takes into account: the nearest ones."""
_DEEPER = 1e-3
"""By how much a motion may go deeper than it begins, m."""


def nearest_bodies(arm: Arm, q: Array, environment: Environment) -> Bodies:
    """The bodies nearest to the arm at joint angles `q` (n,), rad, as compiled programs take them."""
    planes = tuple(body for body in environment if isinstance(body, Plane))
    blocks = tuple(body for body in environment if isinstance(body, Block))
    if len(planes) > PLANES or len(blocks) > BLOCKS:
        starts, ends = (points[0, 1:] for points in shape_segments(arm, q[None]))

        def distance(body: RigidBody) -> float:
            return float(body_distances(body, starts, ends).min())

        planes = tuple(sorted(planes, key=distance)[:PLANES])
        blocks = tuple(sorted(blocks, key=distance)[:BLOCKS])
    return _bodies(planes, blocks)


@functools.lru_cache(maxsize=16)
def _bodies(planes: tuple[Plane, ...], blocks: tuple[Block, ...]) -> Bodies:
    return bodies_of(planes, blocks, (PLANES, BLOCKS))


def check_motion(arm: Arm, q: Array, environment: Environment, tolerance: float) -> None:
    """Refuse a motion through postures `q` (N, n), rad, that brings the arm into a rigid body or into itself.

    Where it begins deeper, it has to lead out.

    Raises
    ------
    PlanningError
        If a posture after the first is more than `tolerance`, m, deep, and deeper than the first; it has the numbers.
    """
    pairs = nearest(arm, q, environment)
    if not pairs:
        return
    first, *later = pairs
    deepest = min(later, key=lambda pair: pair.distance)
    if -deepest.distance > max(tolerance, -first.distance + _DEEPER):
        raise PlanningError(
            f"the plan would bring the arm into a collision: {deepest}, permitted are {1000 * tolerance:g} mm; "
            "it is refused and the plan in force runs out into a hold: choose another goal or posture, move the body, "
            "or raise planning.clearance_weight"
        )
