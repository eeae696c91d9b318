"""Detours: when progress stalls, the arm moves through joint space to another posture that reaches the goal.

A plan of 0.3 s sees no way around a joint's limit, or around a wall: the straight way to a goal often ends there. A
detour leads to a posture at the goal that inverse kinematics finds and that should not press harder than permitted:
straight through joint space to one that is soon reached where that way is permitted, else along a path (see `paths`).
Plans on it minimise the distance of the joints from a posture a little ahead, in place of the distance from the goal.

Postures that differ by whole turns of joints are one: the arm goes to the nearest of them within the limits. An arm
without free dimensions, such as one with six joints and a pose as its goal, has few postures at the goal, and law (1)
does not lead it through singularities. It tries each posture once to which a way leads that passes none, goes for the
goal from where it got, and gives the goal up when none is left.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.errors import UnreachableError
from contact_reach_ros.planning.paths import Statics, connect, duration, durations, is_bound, length, quickened, spaced
from contact_reach_ros.planning.plan import Request
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.terms import METRES_PER_RADIAN
from contact_reach_ros.world.goal import Target

_ROOM = 5.0
"""Factor on the weight of contact on a detour, which has room to avoid it."""

_SPEEDS = 0.01, 0.05
"""Progress that counts: in `_distance`, 1/s, and of the joints on a detour, rad/s."""

_THERE = 0.01, 0.05
"""Distance, m, and angle, rad, from the goal within which an arm has come to where it should."""

_NEARLY = 0.005, 0.025
"""Distance, m, and angle, rad, from the goal of a posture that the joints' limits keep from it."""

_PUSHED_AWAY = 4
"""How many times as long again an arm waits at most that has been at the goal: as long as it was there."""

_CLOSE = 0.05, 0.3
"""Distance, m, and angle, rad, from the goal within which an arm waits twice as long: contact, which becomes cheap
meanwhile, is likely what holds it up."""

_SOON = 0.8
"""Share of the patience after which the next plan may wait for a search: some plans before it is over."""

_NEAR = 0.3
"""Distance of the joints from the posture of a detour at which it ends, rad."""

_SEEDS_NEAR, _SEEDS_ANYWHERE, _SPREAD = 64, 192, 0.5
"""Postures from which inverse kinematics searches, the former with this standard deviation around the arm's, rad."""

_MARGINS, _PARTS = (0.2, 0.05, 0.02), 6
"""Distances from the joints' limits, rad, each for goals that no permitted posture reaches with the one before; and how
many more such searches there are with the last one."""

_CHECKED, _PARTS_CHECKED = 2048, 8
"""Postures from which others at a goal are sought before it is refused, and in how many parts."""

_OTHER = 0.3
"""By as much at least does a joint of the posture differ from what it is, and from that of the last detour, rad."""

_CANDIDATES = 24
"""Postures to which straight ways are looked at, soonest first; a search takes the nearest, and as many others."""

_PRESSING = 2.0
"""By how much longer a way may take that presses less, for each ε, s."""

_SHARES = 0.0, 0.8
"""How much a path may press, in shares of ε, each tried if no path is found with the one before; later searches take
the last."""
_ITERATIONS, _PATHS, _CHANGES = 200, 2, 160
"""Iterations of a search for this many paths, and attempts to make the quickest of them quicker. The arm waits
meanwhile."""

_SLACK = 0.5
"""By how much a way may press harder than the arm does where it begins, N."""

_SPACING, _AHEAD = 0.25, 0.5
"""Between postures on a way, and how far from one the next takes its place, rad."""


class Detour(NamedTuple):
    """Progress towards a goal and on the detours to it."""

    nearest: Array
    """(n,) rad, where the arm was nearest so far, to the goal or on a detour to its posture: goals may move."""
    waited: float
    """Time since then, s; on a detour with half of what it was before, and less by the time at the goal."""
    number: int
    """Searches for a posture so far; each begins from others."""
    is_on: bool
    """Whether the arm is on a detour."""
    postures: Array
    """(k, n) rad: that of the arm at first, or of its last detour; without free dimensions of all detours so far."""
    path: Array
    """(p, n) rad, what is left of the way to the last of them, at which it ends."""

    @property
    def posture(self) -> Array:
        """(n,) rad, to which plans lead."""
        first: Array = self.path[0]
        return first

    def known(self, q: Array, has_few: bool) -> Array:
        """(k, n) rad, postures that lead no further from `q`: of an arm that has few at the goal all that it tried."""
        if has_few:
            return self.postures[1:]
        return np.stack([q, self.postures[-1]][: 1 + (self.number > 0)])

    def remaining(self, q: Array) -> float:
        """How far the way is from joint angles `q` (n,) on, rad."""
        return length(np.concatenate([q[None], self.path]))

    def weights(self, settings: PlanningSettings) -> dict[str, float]:
        """Weights of terms for the next plan, by their names."""
        if not self.is_on:
            return {"detour": 0.0}
        off = dict.fromkeys(("goal", "progress", "orientation"), 0.0)
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
            If every posture at a new goal, or when there is no progress, would press harder than permitted; or if an
            arm without free dimensions has none left to try, and is not among soft obstacles, which may go away.
        """
        settings = self.settings
        if settings.detour_patience == 0.0:
            return request
        seen = request if settings.orientation_weight else request._replace(goal=Target(request.goal.position))
        if last is None or last.detour is None or not request.goal.is_near(last.goal):
            if len(request.spheres) and not request.goal.moves:
                self._check_force(self._statics(seen), seen.goal)
            return request._replace(detour=Detour(request.q, 0.0, 0, False, request.q[None], request.q[None]))
        # Without a plan in force the arm cannot make progress.
        elapsed = min((request.effect_ns - last.effect_ns) * 1e-9, settings.horizon * settings.knot_duration)
        return request._replace(detour=self._follow(last.detour, seen, elapsed))

    def may_search(self, request: Request) -> bool:
        """Whether the plan after this one may wait for a search, since the arm makes no progress."""
        detour = request.detour
        return detour is not None and detour.waited >= _SOON * self._patience(detour, request)

    def _patience(self, detour: Detour, request: Request) -> float:
        """How long the arm waits, s: where it presses, or is likely to, it takes long before contact costs little."""
        *_, offset, angle = _distance(self.arm, request.q, request.goal)
        is_close = bool(len(request.spheres)) and _is_within(_CLOSE, offset, angle)
        return (1 + (detour.is_on or is_close)) * self.settings.detour_patience

    def _follow(self, detour: Detour, request: Request, elapsed: float) -> Detour:
        """The progress `elapsed` seconds later."""
        q, patience = request.q, self.settings.detour_patience
        (now, offset, angle), least = (_distance(self.arm, each, request.goal) for each in (q, detour.nearest))
        is_there, was_there = _is_within(_THERE, offset, angle), _is_within(_THERE, *least[1:])
        has_few = is_bound(self.arm, request.goal)
        if was_there and not is_there:
            if request.goal.moves or has_few:
                return detour._replace(waited=min(detour.waited, 0.0))
            return detour._replace(nearest=q)
        if is_there:
            # An arm may swing in and out at the edge of its goal, where a joint limit keeps it from going on.
            waited = max(detour.waited - elapsed, -_PUSHED_AWAY * patience)
            return detour._replace(nearest=q, waited=waited, is_on=False)
        remaining, before = now, least[0]
        if detour.is_on:
            while len(detour.path) > 1 and np.linalg.norm(q - detour.posture) < _AHEAD:
                detour = detour._replace(path=detour.path[1:])
            remaining, before = detour.remaining(q), detour.remaining(detour.nearest)
        # Less is expected of a slow arm.
        if remaining < before - request.speed_scale * _SPEEDS[detour.is_on] * patience:
            # Contact that holds the arm up on a detour will soon do so again. At the least speed that counts, the time
            # approaches twice the patience.
            detour = detour._replace(nearest=q, waited=0.5 * detour.waited * detour.is_on)
        else:
            detour = detour._replace(waited=detour.waited + elapsed)
        is_late = detour.waited >= self._patience(detour, request)
        if detour.is_on and (remaining < _NEAR or (has_few and is_late)):
            # With few postures at the goal, the arm goes for it from wherever the way to one has led.
            detour = detour._replace(nearest=q, waited=0.0, is_on=False)
        if not is_late or detour.waited == 0.0:
            return detour
        path = self._choose(request, detour)
        if path is None:
            if has_few and not len(request.spheres):
                raise UnreachableError(
                    f"no progress {offset:.3f} m and {angle:.2f} rad from the goal at "
                    f"{np.round(request.goal.position, 3).tolist()} m, and no posture at the goal to which a way was "
                    f"found is left to try after {len(detour.postures) - 1}: joint limits, singularities, or the arm "
                    "itself are in the way; give another orientation, leave it free, or give a goal on the way first"
                )
            return detour._replace(nearest=q, waited=0.0, number=detour.number + 1, is_on=False)
        earlier = detour.postures if has_few else detour.postures[:0]
        postures = np.concatenate([earlier, path[-1:]])
        return Detour(q, 0.0, detour.number + 1, True, postures, path)

    def _statics(self, request: Request) -> Statics:
        return Statics(self.arm, request.spheres, request.q, request.goal)

    def _choose(self, request: Request, detour: Detour) -> Array | None:
        """A way (p, n) to a posture at the goal: the straight one that costs least or, without one, a path.

        None if there is none without rigid bodies or a singularity in the way, and without more force than permitted.
        """
        statics, goal = self._statics(request), request.goal
        known = detour.known(request.q, is_bound(self.arm, goal))
        for postures in _postures(self.arm, request.q, goal, detour.number):
            others = postures[[_differ(self.arm, posture, known) for posture in postures]]
            if len(permitted := others[statics.permitted(others, self.permitted_force)]):
                way = self._straight(statics, permitted)
                return self._search(statics, permitted, detour.number) if way is None else way
        self._check_force(statics, goal)
        return None

    def _check_force(self, statics: Statics, goal: Target) -> None:
        """Raise `UnreachableError` if there are postures at a goal, and each presses harder than permitted."""
        arm, random, least, count = self.arm, np.random.default_rng(0), np.inf, 0
        anywhere = random.uniform(arm.lower, arm.upper, (_CHECKED, arm.n))
        # A plan waits for this: one posture takes 5 ms, a part 60. At most goals the first one is permitted.
        for number, part in enumerate([anywhere[:_SEEDS_NEAR], *np.split(anywhere, _PARTS_CHECKED)]):
            found = _solve(arm, goal, part, _MARGINS[-1], first=not number)
            least = statics.forces(found, of_spheres=True).min(initial=least)
            if least <= self.permitted_force:
                return
            count += len(found) * (number > 0)
        if count:
            raise UnreachableError(
                f"cannot be reached within the contact budget: each of {count} postures at the goal at "
                f"{np.round(goal.position, 3).tolist()} m, {_MARGINS[-1]:g} rad or more from the joints' limits, "
                f"presses with {least:.1f} N or more, permitted {self.permitted_force:g} N; move what is in the way, "
                "give another position or orientation, or leave the orientation free"
            )

    def _straight(self, statics: Statics, postures: Array) -> Array | None:
        """The straight way to one of the postures (N, n) that costs least: its duration, and `_PRESSING` for ε."""
        best, least = None, np.inf
        times = durations(self.arm, statics.start, postures)
        for number in np.argsort(times, kind="stable")[:_CANDIDATES]:
            if times[number] >= least:
                break
            share, force = statics.reach(statics.start, postures[number], self.permitted_force)
            cost = times[number] + _PRESSING * force / self.permitted_force
            if share == 1.0 and cost < least:
                best, least = postures[number][None], cost
        return best

    def _search(self, statics: Statics, postures: Array, number: int) -> Array | None:
        """The quickest of a few paths to some of the postures (N, n)."""
        random, start = np.random.default_rng(number), float(statics.forces(statics.start[None])[0])
        forces = statics.forces(postures)
        # Later searches look for what is more likely to be found.
        shares = _SHARES[number > 0 :]
        for share in shares:
            # At some goals every posture presses nearly as hard as permitted.
            most = max(share * self.permitted_force, share and min(forces.min() + _SLACK, self.permitted_force))
            goals = postures[forces <= most]
            if not len(goals):
                continue
            goals = np.concatenate([goals[:_CANDIDATES], random.permutation(goals[_CANDIDATES:])[:_CANDIDATES]])
            # An arm that presses harder may go on from where it is: nodes of a mesh share what counts for each here.
            limit = max(most, start + _SLACK)
            left = _ITERATIONS // len(shares)
            ways: list[Array] = []
            while left and len(ways) < _PATHS:
                way, taken = connect(statics, goals, limit, _MARGINS[-1], left, random)
                left -= taken
                ways += [] if way is None else [way]
            for way in sorted(ways, key=functools.partial(duration, self.arm)):
                path = spaced(quickened(statics, way, limit, _MARGINS[-1], _CHANGES, random), _SPACING)
                presses = statics.forces(path) > self.permitted_force
                # Out of where it presses too hard, and not into it again.
                if not presses[int(presses.argmin()) :].any():
                    return path[1:]
        return None


def _distance(arm: Arm, q: Array, goal: Target) -> tuple[float, float, float]:
    """How far the goal is, both together; in m; in rad."""
    rotations, origins = link_frames(arm, q)
    offset, angle = float(np.linalg.norm(origins[-1] - goal.position)), goal.angle(rotations[-1])
    return offset + METRES_PER_RADIAN * angle, offset, angle


def _is_within(limits: tuple[float, float], offset: float, angle: float) -> bool:
    return offset < limits[0] and angle < limits[1]


def _solve(arm: Arm, goal: Target, seeds: Array, margin: float, first: bool = False) -> Array:
    return solve_ik(arm, goal.position, goal.rotation, seeds, margin, goal.only_axis, first, _NEARLY)


def _postures(arm: Arm, q: Array, goal: Target, number: int) -> Iterator[Array]:
    """Postures (N, n) at the goal, the nearest first, in parts; the same ones each time."""
    random = np.random.default_rng(number)
    for margin in (*_MARGINS, *[_MARGINS[-1]] * _PARTS):
        near = q + _SPREAD * random.standard_normal((_SEEDS_NEAR, arm.n))
        seeds = np.concatenate([near, random.uniform(arm.lower, arm.upper, (_SEEDS_ANYWHERE, arm.n))])
        found = _solve(arm, goal, seeds, margin)
        found = _turned(found, q, arm.lower + margin, arm.upper - margin)
        if len(found):
            found = found[np.argsort(np.linalg.norm(found - q, axis=1), kind="stable")]
            # Few postures are found many times.
            yield _distinct(arm, found) if is_bound(arm, goal) else found


def _distinct(arm: Arm, postures: Array) -> Array:
    """The postures (N, n) without those that are like an earlier one, rad."""
    kept = postures[:0]
    for posture in postures:
        if _differ(arm, posture, kept):
            kept = np.concatenate([kept, posture[None]])
    return kept


def _differ(arm: Arm, posture: Array, others: Array) -> bool:
    """Whether a posture (n,) is none of others (N, n), turned within the joints' limits, rad."""
    return bool((np.abs(_turned(others, posture, arm.lower, arm.upper) - posture).max(axis=1) > _OTHER).all())


def _turned(postures: Array, q: Array, lower: Array, upper: Array) -> Array:
    """The postures (N, n), rad, within these limits and with each joint whole turns from its place, nearest to `q`."""
    turn = 2.0 * np.pi
    least, most = np.ceil((lower - postures) / turn), np.floor((upper - postures) / turn)
    turned: Array = postures + turn * np.clip(np.round((q - postures) / turn), least, most)
    return turned
