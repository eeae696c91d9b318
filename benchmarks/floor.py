"""How little force there can be: the arm at rest in a soft obstacle, and the gentlest postures on the way to a goal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.inverse_kinematics import solve_ik
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.planning.obstacles import Network
from contact_reach_ros.world.overlap import capsule_links, capsule_segments, radii
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import Spheres, obstacle_spheres, rest_positions

_NEAR = 0.02
"""Spheres that may come to be touched, m from the arm."""
_ROUNDS, _SETTLED = 12, 1e-5
"""Greatest number of changes of the contacts' directions, and the motion of a sphere that counts as none, m."""


class StaticContact:
    """The planner's contact model at rest: surfaces of a stiffness on spheres that a network of springs holds.

    All spheres count, each yields to the forces on all others, and dampers and friction, which add to the force of an
    arm that moves, are left out.
    """

    def __init__(self, arm: Arm, spheres: Spheres, contact_stiffness: float) -> None:
        self._arm, self._rest, self._radius = arm, spheres.rest, spheres.radius
        self._compliance, self._surface = Network(spheres).compliance, 1.0 / contact_stiffness

    def force(self, q: Array) -> float:
        """Of the link that is pressed hardest at the joint angles (n,), rad, N; obstacles move from their rest.

        A link's force is the vector sum over its contacts, as the simulation and the tables have it.
        """
        starts, ends = capsule_segments(self._arm, q)
        axes = ends - starts
        lengths, moved = (axes**2).sum(axis=1)[:, None], np.zeros_like(self._rest)
        for _ in range(_ROUNDS):
            offset = (self._rest + moved)[None] - starts[:, None]
            share = np.clip((offset * axes[:, None]).sum(axis=2) / lengths, 0.0, 1.0)
            away = offset - share[..., None] * axes[:, None]
            distance = np.linalg.norm(away, axis=2)
            depth = radii(self._arm)[:, None] + self._radius - distance
            capsule, sphere = np.nonzero(depth > -_NEAR)
            if not len(sphere):
                return 0.0
            normal = away[capsule, sphere] / distance[capsule, sphere, None]
            # Forces that are none or keep contact: f >= 0, A f - b >= 0, one of them zero, for each contact.
            yielding = (normal @ normal.T) * self._compliance[np.ix_(sphere, sphere)]
            root = np.linalg.cholesky(yielding + self._surface * np.eye(len(sphere)))
            entered = depth[capsule, sphere] + (normal * moved[sphere]).sum(axis=1)
            sizes, _ = nnls(root.T, solve_triangular(root, entered, lower=True))
            before, moved = moved, self._compliance[:, sphere] @ (sizes[:, None] * normal)
            if np.abs(moved - before).max() < _SETTLED:
                break
        links = capsule_links(self._arm)[capsule]
        sums = np.zeros((links.max() + 1, 3))
        np.add.at(sums, links, sizes[:, None] * normal)
        return float(np.linalg.norm(sums, axis=1).max())


class Station(NamedTuple):
    """The gentlest posture at a share of the way, and its force, N."""

    share: float
    force: float
    posture: Array


class Search(NamedTuple):
    """How postures are searched for; at each station, each posture is the best of all that were tried."""

    stations: int = 13
    """From the start, exclusive, to the goal."""
    seeds: int = 150
    generations: int = 20
    kept: int = 5
    children: int = 3
    aside: float = 0.06
    """m: how far the tip may be from the straight way, but for the goal."""
    margin: float = 0.05
    """Of the joints from their limits, rad."""


def floor(scene: Scene, contact_stiffness: float, search: Search, seed: int) -> list[Station]:
    """The gentlest posture at each station of the way, found at random and improved at random.

    With the orientation of the start held, the tip crosses every plane across its straight way to the target; so no
    motion within `aside` of that way has a peak force, at rest, below the largest of these.
    """
    arm, random = scene.arm, np.random.default_rng(seed)
    contact = StaticContact(arm, obstacle_spheres(scene, rest_positions(scene)), contact_stiffness)
    rotations, origins = link_frames(arm, scene.start)
    begin, rotation = origins[-1], rotations[-1]
    way = scene.target - begin
    across = np.linalg.svd(way[None])[2][1:]
    found: list[Station] = []
    last = scene.start
    for share in np.linspace(0.0, 1.0, search.stations + 1)[1:]:
        aside = 0.0 if share == 1.0 else search.aside
        near = [last + 0.3 * random.standard_normal((search.seeds // 2, arm.n))]
        seeds = np.concatenate([last[None], *near, random.uniform(arm.lower, arm.upper, (search.seeds // 2, arm.n))])
        best: list[Station] = []
        for generation in range(search.generations + 1):
            narrow = 0.8**generation
            spread = 0.2 * narrow * random.standard_normal((len(best), search.children, arm.n))
            parents = [each.posture + more for each, more in zip(best, spread, strict=True)] or [seeds]
            for group in parents:
                tip = link_frames(arm, group[0])[1][-1] if best else begin
                offset = across @ (tip - begin) + narrow * aside * random.uniform(-1.0, 1.0, 2)
                position = begin + share * way + np.clip(offset, -aside, aside) @ across
                postures = solve_ik(arm, position, rotation, group, search.margin)
                best += [Station(float(share), contact.force(posture), posture) for posture in postures]
            best = sorted(best, key=lambda each: each.force)[: search.kept]
            if best and best[0].force == 0.0:
                break
        if best:
            last = best[0].posture
            found.append(best[0])
    return found
