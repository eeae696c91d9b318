"""Detours: when progress stalls, the arm moves through joint space to another posture that reaches the goal.

A plan of 0.3 s sees no way around a joint's limit: with the orientation held, the straight way to a goal often ends
there, whatever the arm may touch. A detour leads straight through joint space, where limits are in the way of nothing,
to the nearest posture at the goal that inverse kinematics finds and that should not press harder than permitted.
Plans on it minimise the distance of the joints from that posture in place of the distance from the goal.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.planning.obstacles import Network
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.collision import clearances, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

NAME = "detour"
"""Of the term of the cost that leads to the posture."""

_ON = {"goal": 0.0, "progress": 0.0, "orientation": 0.0, "contact": 5.0}
"""Factors on the weights of the cost's terms on a detour, which has room to avoid contact."""
_OFF = {NAME: 0.0}
"""The same without one."""

_SPEEDS = 0.01, 0.1
"""Progress that counts: in `_distance`, 1/s, and of the joints on a detour, rad/s."""

_THERE = 0.01, 0.05
"""Distance, m, and angle, rad, from the goal within which an arm has come to where it should."""

_NEAR = 0.1
"""Distance of the joints from the posture of a detour at which it ends, rad."""

_METRES_PER_RADIAN = 0.2

_SEEDS_NEAR, _SEEDS_ANYWHERE, _SPREAD = 64, 192, 0.5
"""Postures from which inverse kinematics searches, the former with this standard deviation around the arm's, rad."""

_MARGINS = 0.2, 0.05
"""Distances from the joints' limits, rad, the second for goals that no posture reaches with the first."""

_OTHER = 0.3
"""By as much at least does a joint of the posture differ from what it is, and from that of the last detour, rad."""

_CANDIDATES, _STATIONS = 24, 12
"""Postures that are looked at, the nearest ones, and places along the way to each."""


class Detour(NamedTuple):
    """Progress towards a goal and on the detours to it."""

    least: float
    """Least distance so far: in m and `_METRES_PER_RADIAN` from the goal, or in rad from the posture."""
    waited: float
    """Time since then, s."""
    number: int
    """Searches for a posture so far; each begins from others."""
    is_on: bool
    """Whether the arm is on a detour."""
    arrived: bool
    """Whether it has been at the goal: one that is pushed away then stays in its posture."""
    posture: Array
    """(n,) rad, of the last detour; where there was none that of the arm."""


def begin(q: Array) -> Detour:
    """The state at joint angles `q` (n,), rad, with a new goal."""
    return Detour(np.inf, 0.0, 0, False, False, q)


def current(detour: Detour | None) -> int:
    """Number of the detour that the arm is on; 0 for none."""
    return detour.number if detour is not None and detour.is_on else 0


def weight_factors(detour: Detour | None) -> dict[str, float]:
    """Factors on the weights of the cost's terms; `detour` is None where the settings permit none."""
    if detour is None:
        return {}
    return _ON if detour.is_on else _OFF


def follow(
    detour: Detour,
    arm: Arm,
    q: Array,
    goal: Target,
    spheres: Spheres,
    elapsed: float,
    settings: PlanningSettings,
    permitted_force: float,
    pace: float,
) -> Detour:
    """The state some time later.

    Parameters
    ----------
    q
        (n,) measured joint angles, rad.
    spheres
        Obstacles, where they are now.
    elapsed
        Time since the last plan during which it was in force, s: without a plan the arm cannot make progress.
    permitted_force
        ε of (4d), N.
    pace
        Share of γ that plans use, 0 to 1: less progress is expected of a slow arm.
    """
    distance, offset, angle = _distance(arm, q, goal)
    remaining = float(np.linalg.norm(q - detour.posture)) if detour.is_on else distance
    if remaining < detour.least - pace * _SPEEDS[detour.is_on] * settings.detour_patience:
        detour = detour._replace(least=remaining, waited=0.0)
    else:
        detour = detour._replace(waited=detour.waited + elapsed)
    is_there = offset < _THERE[0] and angle < _THERE[1]
    if detour.is_on and (remaining < _NEAR or is_there):
        detour = detour._replace(least=distance, waited=0.0, is_on=False)
    detour = detour._replace(arrived=detour.arrived or is_there)
    if detour.waited >= settings.detour_patience and not detour.arrived:
        posture = _choose(arm, q, goal, spheres, detour, settings, permitted_force)
        if posture is None:
            detour = detour._replace(least=distance, waited=0.0, number=detour.number + 1, is_on=False)
        else:
            length = float(np.linalg.norm(posture - q))
            detour = Detour(length, 0.0, detour.number + 1, True, False, posture)
    return detour


def _distance(arm: Arm, q: Array, goal: Target) -> tuple[float, float, float]:
    """How far the goal is, both together; in m; in rad."""
    rotations, origins = link_frames(arm, q)
    offset, angle = float(np.linalg.norm(origins[-1] - goal.position)), goal.angle(rotations[-1])
    return offset + _METRES_PER_RADIAN * angle, offset, angle


def _choose(
    arm: Arm,
    q: Array,
    goal: Target,
    spheres: Spheres,
    detour: Detour,
    settings: PlanningSettings,
    permitted_force: float,
) -> Array | None:
    """The posture that costs least to get to: a radian for each radian, and for each share ε of the force on the way.

    None if there is none without rigid bodies in the way, and without more force than permitted.
    """
    softness = 1.0 / settings.contact_stiffness + np.diag(Network(spheres).compliance) if len(spheres) else np.zeros(0)
    best, least = None, np.inf
    for posture in _postures(arm, q, goal, detour):
        length = float(np.linalg.norm(posture - q))
        if length >= least:
            break
        way = q + np.linspace(0.0, 1.0, 1 + _STATIONS)[:, None] * (posture - q)
        first, *later = [pair.distance for pair in nearest(arm, way, spheres.environment)] or [0.0]
        if min(later, default=0.0) < min(first, 0.0):
            continue
        # At rest, of each sphere as if it were the only one.
        depths = [np.maximum(-clearances(arm, station, spheres), 0.0) for station in way[1:]]
        force = float((depths / softness).max(initial=0.0))
        if force <= permitted_force and length + force / permitted_force < least:
            best, least = posture, length + force / permitted_force
    return best


def _postures(arm: Arm, q: Array, goal: Target, detour: Detour) -> Iterator[Array]:
    """Postures at the goal other than the present and the last one, the nearest first; the same ones each time."""
    random = np.random.default_rng(detour.number)
    for margin in _MARGINS:
        near = q + _SPREAD * random.standard_normal((_SEEDS_NEAR, arm.n))
        anywhere = random.uniform(arm.lower, arm.upper, (_SEEDS_ANYWHERE, arm.n))
        seeds = np.concatenate([near, anywhere])
        found = solve_ik(arm, goal.position, goal.rotation, seeds, margin, goal.only_axis)
        for known in (q, detour.posture) if detour.number else (q,):
            found = found[np.abs(found - known).max(axis=1) > _OTHER]
        yield from found[np.argsort(np.linalg.norm(found - q, axis=1), kind="stable")[:_CANDIDATES]]
        if len(found):
            return
