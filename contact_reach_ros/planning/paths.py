"""Paths through joint space on which no link presses harder than a limit.

The search is RRT-Connect (Kuffner and LaValle, 2000), from the start and from all goals at once.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.arm.capsules import moving, shape_segments
from contact_reach_ros.arm.inverse_kinematics import pose_errors
from contact_reach_ros.arm.kinematics import tip_positions
from contact_reach_ros.planning.obstacles import Network
from contact_reach_ros.planning.transfer.contact import CONTACT_STIFFNESS
from contact_reach_ros.world.collision import GOAL_CLEARANCE, nearest, overlap_depths
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

_RESOLUTION = 0.02
"""Largest motion of a point of the arm between two postures that are looked at, m."""
_STEP, _LEAST_STEP = 1.0, 0.05
"""Largest step towards a sample, and the smallest that counts as a step, rad; towards the other tree the arm goes all
the way."""
_PACE = 0.5, 0.12
"""Of the joints together, rad/s, and of the tip, m/s, on a detour, with the default γ."""
_LOOKS = 9
"""Postures on a straight motion between which the tip's way is measured."""
_CHUNK = 32
"""Postures on a motion that are looked at together."""
_PART, _BOW, _QUICKER = 0.5, 0.3, 1e-3
"""Between postures of a path that is made quicker, and how far its parts are bowed, standard deviation, rad; by how
much quicker a part has to be, s."""


@functools.cache
def levers(arm: Arm) -> Array:
    """(n,) m: turning joint i by an angle moves no point of the arm by more than that angle times its lever."""
    offsets = np.array([joint.offset for joint in arm.joints])
    last = arm.capsules[-1]
    # The origin of the next joint only turns with this one as far as it lies beside this one's axis.
    beside = np.append(np.linalg.norm(offsets[1:, :2], axis=1), 0.0)
    lengths = np.append(np.linalg.norm(offsets[1:], axis=1), 0.0)
    beyond = np.array([lengths[joint + 1 :].sum() for joint in range(arm.n)])
    return beside + beyond + float(np.linalg.norm(last.end)) + max(capsule.radius for capsule in arm.capsules)


def is_bound(arm: Arm, goal: Target) -> bool:
    """Whether the goal leaves the arm no free dimension, so that few postures are at it."""
    return arm.n == (3 if goal.rotation is None else 5 if goal.only_axis else 6)


class Statics:
    """What an arm at rest meets on straight motions through joint space.

    Parameters
    ----------
    spheres
        Soft obstacles, where they are without the arm, and the rigid bodies.
    start
        (n,) rad, where motions begin. They keep as far from rigid bodies as a goal has to, or as the arm does there.
    goal
        Of the motions. An arm to which it leaves no free dimension meets singularities, too.
    """

    def __init__(self, arm: Arm, spheres: Spheres, start: Array, goal: Target) -> None:
        self.arm, self.start, self._goal = arm, start, goal
        self._spheres = dataclasses.replace(spheres, center=spheres.rest)
        self._stiffness = 1.0 / (1.0 / CONTACT_STIFFNESS + Network(spheres).softness) if len(spheres) else np.zeros(0)
        self._side = self._sides(start[None])
        pairs = nearest(arm, start[None], spheres.environment)
        self._clearance = min(pairs[0].distance, GOAL_CLEARANCE) if pairs else -np.inf

    def forces(self, postures: Array, of_spheres: bool = False) -> Array:
        """(N,) N, the largest force on one link, or that of one sphere, in postures (N, n).

        A sphere yields as if it were the only one: with a mesh, forces on a link are rather too large.
        """
        if not len(self._spheres):
            return np.zeros(len(postures))
        starts, ends = (points[:, moving(self.arm)] for points in shape_segments(self.arm, postures))
        depths = overlap_depths(self.arm, starts, ends, self._spheres.center, self._spheres.radius)
        forces = np.maximum(depths, 0.0) * self._stiffness
        return forces.max(axis=(1, 2)) if of_spheres else forces.sum(axis=2).max(axis=1)

    def free(self, postures: Array) -> NDArray[np.bool_]:
        """(N,) whether postures (N, n) meet no rigid body, and no singularity on the way."""
        if not len(postures):
            return np.zeros(0, bool)
        pairs = nearest(self.arm, postures, self._spheres.environment)
        apart = np.array([pair.distance for pair in pairs]) if pairs else np.full(len(postures), np.inf)
        found: NDArray[np.bool_] = (apart >= self._clearance) & (self._sides(postures) == self._side)
        return found

    def permitted(self, postures: Array, limit: float) -> NDArray[np.bool_]:
        """(N,) whether postures (N, n) are `free`, and no link presses harder than a limit, N."""
        permitted: NDArray[np.bool_] = self.free(postures) & (self.forces(postures) <= limit)
        return permitted

    def reach(self, start: Array, end: Array, limit: float) -> tuple[float, float]:
        """How much of a straight motion between two postures (n,) is permitted, 0 to 1, and the largest force on it."""
        count = 1 + max(1, int(np.ceil(np.abs(end - start) @ levers(self.arm) / _RESOLUTION)))
        postures, most = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start), 0.0
        for first in range(1, count, _CHUNK):
            ahead = postures[first : first + _CHUNK]
            forces = self.forces(ahead)
            permitted = _before(forces > limit)
            permitted = _before(~self.free(ahead[:permitted]))
            most = max(most, forces[:permitted].max(initial=0.0))
            if permitted < len(ahead):
                return (first + permitted - 1) / (count - 1), float(most)
        return 1.0, float(most)

    def _sides(self, postures: Array) -> Array:
        """(N,) of the singularities on which an arm without free dimensions is."""
        goal = self._goal
        if not is_bound(self.arm, goal):
            return np.zeros(len(postures))
        _, jacobians = pose_errors(self.arm, goal.position, goal.rotation, postures, goal.only_axis)
        return np.linalg.slogdet(jacobians)[0]


def _before(refused: NDArray[np.bool_]) -> int:
    """How many come before the first that is refused."""
    return int(refused.argmax()) if refused.any() else len(refused)


class _Tree:
    """Postures, each with the one that it was reached from."""

    def __init__(self, roots: Array) -> None:
        self.postures, self._parents = [*roots], [-1] * len(roots)

    def grow(self, statics: Statics, sample: Array, step: float, limit: float) -> tuple[int, bool]:
        """Move from the nearest posture towards a sample, by `step` rad at most.

        Returns the number of the last posture, the nearest one if the arm cannot move, and whether it is the sample.
        """
        nearest = int(((np.array(self.postures) - sample) ** 2).sum(axis=1).argmin())
        way = sample - self.postures[nearest]
        length = float(np.linalg.norm(way))
        if length < 1e-9:
            return nearest, True
        wanted = min(length, step)
        share, _ = statics.reach(self.postures[nearest], self.postures[nearest] + way * wanted / length, limit)
        if share * wanted < min(_LEAST_STEP, wanted):
            return nearest, False
        self.postures.append(self.postures[nearest] + way * share * wanted / length)
        self._parents.append(nearest)
        return len(self.postures) - 1, share * wanted >= length - 1e-9

    def path(self, number: int) -> list[Array]:
        """From a posture back to a root."""
        found = []
        while number >= 0:
            found.append(self.postures[number])
            number = self._parents[number]
        return found


def connect(
    statics: Statics, goals: Array, limit: float, margin: float, iterations: int, random: np.random.Generator
) -> tuple[Array | None, int]:
    """Postures (P, n) of a path from the start to one of the goals (G, n) on which no link presses harder than a limit.

    It keeps a margin from the joints' limits, rad, or as much as start and goals do. None if none is found in these
    iterations. Also returns how many it took.
    """
    arm, start = statics.arm, statics.start
    lower = np.minimum(np.array(arm.lower) + margin, start)
    upper = np.maximum(np.array(arm.upper) - margin, start)
    trees = [_Tree(start[None]), _Tree(goals)]
    for iteration in range(iterations):
        own, other = trees if iteration % 2 == 0 else trees[::-1]
        # The way that needs no search is tried first.
        sample = goals[0] if iteration == 0 else random.uniform(lower, upper)
        number, _ = own.grow(statics, sample, _STEP if iteration else np.inf, limit)
        met, is_there = other.grow(statics, own.postures[number], np.inf, limit)
        if is_there:
            halves = own.path(number)[::-1], other.path(met)[1:]
            path = np.array([*halves[0], *halves[1]])
            return path if own is trees[0] else path[::-1], iteration + 1
    return None, iterations


def spaced(path: Array, spacing: float) -> Array:
    """The path (P', n) with postures in between its own (P, n), at most `spacing` apart, rad."""
    found = [path[0]]
    for start, end in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing)))
        found.extend(start + share * (end - start) for share in np.arange(1, count + 1) / count)
    return np.array(found)


def quickened(
    statics: Statics, path: Array, limit: float, margin: float, tries: int, random: np.random.Generator
) -> Array:
    """A path (P', n) that takes less time than a path (P, n), rad, on which no link presses harder than a limit, N.

    Parts of it become straight or are bowed at random, by turns, as far as the margin from the joints' limits, rad.
    """
    arm, path = statics.arm, spaced(path, _PART)
    lower = np.minimum(np.array(arm.lower) + margin, path.min(axis=0))
    upper = np.maximum(np.array(arm.upper) - margin, path.max(axis=0))
    for number in range(tries):
        first, last = sorted(random.integers(len(path), size=2))
        if last - first < 2:
            continue
        part = path[first : last + 1]
        if number % 2 == 0:
            other = spaced(part[[0, -1]], _PART)
        else:
            bow = np.sin(np.linspace(0.0, np.pi, len(part)))
            other = np.clip(part + bow[:, None] * random.normal(0.0, _BOW, arm.n), lower, upper)
        if duration(arm, other) < duration(arm, part) - _QUICKER and all(
            statics.reach(start, end, limit)[0] == 1.0 for start, end in itertools.pairwise(other)
        ):
            path = np.concatenate([path[:first], other, path[last + 1 :]])
    return path


def durations(arm: Arm, starts: Array, ends: Array) -> Array:
    """(N,) s, about what straight motions from postures (N, n) or (n,) to (N, n), rad, take: joints or tip are slow."""
    ways = starts + np.linspace(0.0, 1.0, _LOOKS)[:, None, None] * (ends - starts)
    tips = tip_positions(arm, ways.reshape(-1, arm.n)).reshape(*ways.shape[:2], 3)
    tip = np.linalg.norm(np.diff(tips, axis=0), axis=2).sum(axis=0)
    found: Array = np.maximum(np.linalg.norm(ends - starts, axis=1) / _PACE[0], tip / _PACE[1])
    return found


def duration(arm: Arm, path: Array) -> float:
    """About what a path (P, n), rad, takes, s."""
    return float(durations(arm, path[:-1], path[1:]).sum())


def length(path: Array) -> float:
    """Of a path (P, n), rad."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
