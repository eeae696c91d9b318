"""Detours: when progress stalls, the arm moves through joint space to another posture that reaches the goal.

A plan of 0.3 s sees no way around a joint's limit: with the orientation held, the straight way to a goal often ends
there, whatever the arm may touch. A detour leads straight through joint space, where limits are in the way of nothing,
to the nearest posture at the goal that inverse kinematics finds and that should not press harder than permitted.
Plans on it minimise the distance of the joints from that posture in place of the distance from the goal.

Postures that differ by whole turns of joints are one: the arm goes to the nearest of them within the limits. An arm
without free dimensions, such as one with six joints and a pose as its goal, has few postures at the goal, and law (1)
does not lead it through singularities. It tries each posture once that no singularity separates it from, goes for the
goal from where it got, and gives the goal up when none is left.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.arm.inverse_kinematics import pose_errors, solve_ik
from contact_reach_ros.errors import UnreachableError
from contact_reach_ros.planning.obstacles import Network
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.world.collision import clearances, nearest
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

_ROOM = 5.0
"""Factor on the weight of contact on a detour, which has room to avoid it."""

_SPEEDS = 0.01, 0.1
"""Progress that counts: in `_distance`, 1/s, and of the joints on a detour, rad/s."""

_THERE = 0.01, 0.05
"""Distance, m, and angle, rad, from the goal within which an arm has come to where it should."""

_NEAR = 0.1
"""Distance of the joints from the posture of a detour at which it ends, rad."""

_METRES_PER_RADIAN = 0.2

_SEEDS_NEAR, _SEEDS_ANYWHERE, _SPREAD = 64, 192, 0.5
"""Postures from which inverse kinematics searches, the former with this standard deviation around the arm's, rad."""

_SEEDS_LAST, _PARTS = 2048, 8
"""From which postures are sought before a goal is given up, and in how many parts."""

_MARGINS = 0.2, 0.05, 0.02
"""Distances from the joints' limits, rad, each for goals that no posture reaches with the one before."""

_OTHER = 0.3
"""By as much at least does a joint of the posture differ from what it is, and from that of the last detour, rad."""

_CANDIDATES, _STATIONS = 24, 12
"""Postures that are looked at, the nearest ones, and places along the way to each."""


class Detour(NamedTuple):
    """Progress towards a goal and on the detours to it."""

    nearest: Array
    """(n,) rad, where the arm was nearest so far, to the goal or on a detour to its posture: goals may move."""
    waited: float
    """Time since then, s."""
    number: int
    """Searches for a posture so far; each begins from others."""
    is_on: bool
    """Whether the arm is on a detour."""
    postures: Array
    """(k, n) rad: that of the arm at first, or of its last detour; without free dimensions of all detours so far."""

    @property
    def posture(self) -> Array:
        """(n,) rad, of the last detour; where there was none that of the arm."""
        last: Array = self.postures[-1]
        return last

    def weights(self, settings: PlanningSettings) -> dict[str, float]:
        """Weights of terms for the next plan, by their names."""
        if not self.is_on:
            return {"detour": 0.0}
        off = dict.fromkeys(("goal", "progress", "terminal", "orientation"), 0.0)
        # As on the way to a goal: permitted contact must not keep the arm from where it has to be.
        share = math.exp(-self.waited / settings.contact_patience) if settings.contact_patience else 1.0
        return off | {"contact": _ROOM * share * settings.contact_weight}


@dataclass(frozen=True)
class Detours:
    """Follows the progress of plans towards their goals, and chooses detours."""

    arm: Arm
    settings: PlanningSettings
    permitted_force: float
    """ε of (4d), N."""

    def target(self, request: Request, last: Request | None) -> Request:
        """The request with the progress towards its goal, and the detour that leads there.

        Parameters
        ----------
        request
            Request for a plan.
        last
            The one that the last plan was made for; None after a reset.

        Raises
        ------
        UnreachableError
            If the arm makes no progress, and every posture at the goal would press harder than permitted; or one
            without free dimensions has none left to try, and is not among soft obstacles, which may go away.
        """
        settings = self.settings
        if settings.detour_patience == 0.0:
            return request
        if last is None or last.detour is None or not request.goal.is_near(last.goal):
            return request._replace(detour=Detour(request.q, 0.0, 0, False, request.q[None]))
        # Without a plan in force the arm cannot make progress.
        elapsed = min((request.effect_ns - last.effect_ns) * 1e-9, settings.horizon * settings.knot_duration)
        goal = request.goal if settings.orientation_weight else Target(request.goal.position)
        return request._replace(detour=self._follow(last.detour, request._replace(goal=goal), elapsed))

    def _follow(self, detour: Detour, request: Request, elapsed: float) -> Detour:
        """The progress `elapsed` seconds later."""
        # On a detour the arm has waited long before contact costs little.
        q, patience = request.q, (1 + detour.is_on) * self.settings.detour_patience
        (now, offset, angle), least = (_distance(self.arm, each, request.goal) for each in (q, detour.nearest))
        # One that has been at the goal, and is pushed away, stays in its posture.
        is_there, was_there = _is_there(offset, angle), _is_there(*least[1:])
        remaining, before = now, least[0]
        if detour.is_on:
            remaining, before = (float(np.linalg.norm(each - detour.posture)) for each in (q, detour.nearest))
        # Less is expected of a slow arm.
        if remaining < before - request.speed_scale * _SPEEDS[detour.is_on] * patience:
            detour = detour._replace(nearest=q, waited=0.0)
        else:
            detour = detour._replace(waited=detour.waited + elapsed)
        is_bound, is_late = _is_bound(self.arm, request.goal), detour.waited >= patience
        if is_there or (detour.is_on and (remaining < _NEAR or (is_bound and is_late))):
            # With few postures at the goal, the arm goes for it from wherever the way to one has led.
            detour = detour._replace(nearest=q, waited=0.0, is_on=False)
        if detour.waited < patience or was_there:
            return detour
        posture = self._choose(request, detour)
        if posture is None:
            if is_bound and not len(request.spheres):
                raise UnreachableError(
                    f"no progress {offset:.3f} m and {angle:.2f} rad from the goal at "
                    f"{np.round(request.goal.position, 3).tolist()} m, and no posture at the goal is left to try after "
                    f"{len(detour.postures) - 1}: joint limits, singularities, or the arm itself are in the way; give "
                    "another orientation, leave it free, or give a goal on the way first"
                )
            if not detour.number:
                self._check_force(request)
            return detour._replace(nearest=q, waited=0.0, number=detour.number + 1, is_on=False)
        earlier = detour.postures if is_bound else detour.postures[:0]
        postures = np.concatenate([earlier, posture[None]])
        return Detour(q, 0.0, detour.number + 1, True, postures)

    def _choose(self, request: Request, detour: Detour) -> Array | None:
        """The posture that costs least to get to: 1 for each radian, and 1 for each ε of the force on the way.

        None if there is none without rigid bodies or a singularity in the way, and without more force than permitted.
        """
        arm, q, spheres, permitted = self.arm, request.q, request.spheres, self.permitted_force
        softness = self._softness(spheres)
        best, least = None, np.inf
        for posture in _postures(arm, q, request.goal, detour):
            length = float(np.linalg.norm(posture - q))
            if length >= least:
                break
            way = q + np.linspace(0.0, 1.0, 1 + _STATIONS)[:, None] * (posture - q)
            first, *later = [pair.distance for pair in nearest(arm, way, spheres.environment)] or [0.0]
            if min(later, default=0.0) < min(first, 0.0) or _is_singular(arm, way, request.goal):
                continue
            force = max(_force(arm, station, spheres, softness) for station in way[1:])
            if force <= permitted and length + force / permitted < least:
                best, least = posture, length + force / permitted
        return best

    def _check_force(self, request: Request) -> None:
        """Raise `UnreachableError` if there are postures at the goal, and none that is permitted, as far as is seen."""
        arm, goal, spheres = self.arm, request.goal, request.spheres
        if not len(spheres):
            return
        seeds = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_SEEDS_LAST, arm.n))
        # Where the arm does not press them.
        alone, softness = dataclasses.replace(spheres, center=spheres.rest), self._softness(spheres)
        least, count = np.inf, 0
        # Of most goals the first part has a posture that is permitted.
        for part in np.split(seeds, _PARTS):
            for posture in solve_ik(arm, goal.position, goal.rotation, part, _MARGINS[-1], goal.only_axis):
                least, count = min(least, _force(arm, posture, alone, softness)), count + 1
                if least <= self.permitted_force:
                    return
        if count:
            raise UnreachableError(
                f"cannot be reached within the contact budget: each of {count} postures at the goal at "
                f"{np.round(goal.position, 3).tolist()} m presses with {least:.1f} N or more, permitted "
                f"{self.permitted_force:g} N; move what is in the way, give another position or orientation, or leave "
                "the orientation free"
            )

    def _softness(self, spheres: Spheres) -> Array:
        """(K,) m/N, of each sphere with its surface as if it were the only one."""
        if not len(spheres):
            return np.zeros(0)
        softness: Array = 1.0 / self.settings.contact_stiffness + Network(spheres).softness
        return softness


def _force(arm: Arm, posture: Array, spheres: Spheres, softness: Array) -> float:
    """The largest force of a sphere on the arm at rest in a posture (n,), N."""
    return float((np.maximum(-clearances(arm, posture, spheres), 0.0) / softness).max(initial=0.0))


def _distance(arm: Arm, q: Array, goal: Target) -> tuple[float, float, float]:
    """How far the goal is, both together; in m; in rad."""
    rotations, origins = link_frames(arm, q)
    offset, angle = float(np.linalg.norm(origins[-1] - goal.position)), goal.angle(rotations[-1])
    return offset + _METRES_PER_RADIAN * angle, offset, angle


def _is_there(offset: float, angle: float) -> bool:
    return offset < _THERE[0] and angle < _THERE[1]


def _is_bound(arm: Arm, goal: Target) -> bool:
    """Whether the goal leaves the arm no free dimension, so that few postures are at it."""
    return arm.n == (3 if goal.rotation is None else 5 if goal.only_axis else 6)


def _is_singular(arm: Arm, way: Array, goal: Target) -> bool:
    """Whether an arm without free dimensions would pass a singularity on a way (N, n), rad."""
    if not _is_bound(arm, goal):
        return False
    _, jacobians = pose_errors(arm, goal.position, goal.rotation, way, goal.only_axis)
    return bool(np.ptp(np.linalg.slogdet(jacobians)[0]) > 0.0)


def _postures(arm: Arm, q: Array, goal: Target, detour: Detour) -> Iterator[Array]:
    """Postures at the goal that may lead on, the nearest first; the same ones each time.

    They are others than the present and the last one; without free dimensions those that were not tried, each once.
    """
    random, is_bound = np.random.default_rng(detour.number), _is_bound(arm, goal)
    known = [*detour.postures[1:]] if is_bound else [q, detour.posture][: 1 + (detour.number > 0)]
    for margin in _MARGINS:
        lower, upper = arm.lower + margin, arm.upper - margin
        near = q + _SPREAD * random.standard_normal((_SEEDS_NEAR, arm.n))
        anywhere = random.uniform(arm.lower, arm.upper, (_SEEDS_ANYWHERE, arm.n))
        seeds = np.concatenate([near, anywhere])
        found = _turned(solve_ik(arm, goal.position, goal.rotation, seeds, margin, goal.only_axis), q, lower, upper)
        found = found[np.argsort(np.linalg.norm(found - q, axis=1), kind="stable")]
        for posture in known:
            found = found[_differs(found, posture, lower, upper)]
        if not is_bound:
            yield from found[:_CANDIDATES]
            if len(found):
                return
            continue
        while len(found):
            yield found[0]
            found = found[_differs(found, found[0], lower, upper)]


def _differs(postures: Array, other: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Which of the postures (N, n) are not the other one (n,), turned within the limits, rad."""
    differs: NDArray[np.bool_] = np.abs(_turned(postures, other, lower, upper) - other).max(axis=1) > _OTHER
    return differs


def _turned(postures: Array, q: Array, lower: Array, upper: Array) -> Array:
    """The postures (N, n), rad, within these limits and with each joint whole turns from its place, nearest to `q`."""
    turn = 2.0 * np.pi
    least, most = np.ceil((lower - postures) / turn), np.floor((upper - postures) / turn)
    turned: Array = postures + turn * np.clip(np.round((q - postures) / turn), least, most)
    return turned
