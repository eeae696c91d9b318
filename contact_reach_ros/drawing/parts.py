"""The arm, the obstacles and paths, as shapes."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.palette import SKY_BLUE, rgb
from contact_reach_ros.drawing.shapes import Capsule, Colour, Cylinder, Mesh, Shape, Solid, Sphere, move
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.rigid import Block
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import by_obstacle

BODY = (0.86, 0.87, 0.88)
_ACCENT = (0.95, 0.45, 0.1)
DARK = (0.22, 0.23, 0.25)
FOAM = (0.42, 0.8, 0.58)
NODE = (0.1, 0.55, 0.35)
RIGID = (0.6, 0.58, 0.55)
_FLOOR = (0.93, 0.93, 0.93)
_COVER_RADIUS = 0.62
"""Radius of a joint's cover, in radii of the link."""
_PATH_RADIUS = 0.008
_PATH_POINTS = 120
_SHORTEST = 1e-6
"""Shortest piece of a path that has a direction, m."""


def arm_shapes(arm: Arm, q: ArrayLike, tint: str = "") -> list[Shape]:
    """The arm's collision capsules, with covers at the joints that bend it, and its base.

    Parameters
    ----------
    arm
        Arm to show.
    q
        (n,) joint angles, rad.
    tint
        Colour '#rrggbb' of the whole arm except its base, instead of its own colours.
    """
    rotations, origins = link_frames(arm, q)
    base, *links = link_shapes(arm)
    shapes: list[Shape] = list(base)
    for link, parts in enumerate(links):
        for part in parts:
            moved = move(part, rotations[link], origins[link])
            shapes.append(dataclasses.replace(moved, colour=(*rgb(tint), 1.0)) if tint else moved)
    return shapes


@functools.cache
def link_shapes(arm: Arm) -> tuple[tuple[Solid, ...], ...]:
    """Shapes of the base, then of each link in its own frame, for `arm_shapes`; empty for a link without a capsule."""
    base = arm.base_capsule
    ground, top = np.zeros(3), np.array(base.end)
    shapes: list[list[Solid]] = [[] for _ in range(arm.n + 1)]
    shapes[0] = [
        Cylinder(ground, top, base.radius, (*BODY, 1.0)),
        Sphere(top, base.radius, (*BODY, 1.0)),
        Cylinder(ground, np.array([0.0, 0.0, 0.03]), 1.15 * base.radius, (*DARK, 1.0)),
    ]
    thickness = base.radius
    for capsule in arm.capsules:
        last = capsule.link == arm.n
        start, end = np.array(capsule.start, float), np.array(capsule.end, float)
        shapes[capsule.link].append(Capsule(start, end, capsule.radius, (*(DARK if last else BODY), 1.0)))
        # A joint whose axis, z, runs along its link only twists the arm; it has one cover.
        if len(shapes[capsule.link]) == 1 and abs(end - start)[2] < 0.5 * np.linalg.norm(end - start):
            half = np.array([0.0, 0.0, 1.04 * max(thickness, capsule.radius)])
            shapes[capsule.link].append(Cylinder(-half, half, _COVER_RADIUS * capsule.radius, (*_ACCENT, 1.0)))
        thickness = capsule.radius
    return tuple(map(tuple, shapes))


def obstacle_shapes(scene: Scene, positions: Array, opacity: float = 0.55) -> list[Shape]:
    """Spheres as they are, and lattices as small nodes with the surface that they span.

    Parameters
    ----------
    scene
        Scene with the obstacles.
    positions
        (K, 3), m, in the order of `world.spheres.rest_positions`.
    opacity
        Opacity of spheres and surfaces, through which the arm should be visible.
    """
    green = (*FOAM, opacity)
    shapes: list[Shape] = []
    for obstacle, centers in by_obstacle(scene, positions):
        if not obstacle.lattice:
            shapes += [Sphere(center, obstacle.radius, green) for center in centers]
            continue
        for node, fixed in zip(centers, obstacle.fixed, strict=True):
            shapes.append(Sphere(node, 0.5 * obstacle.radius, (*(DARK if fixed else NODE), 1.0)))
        shapes.append(_surface(obstacle, centers, green))
    return shapes


def environment_shapes(scene: Scene) -> list[Shape]:
    """Its rigid blocks; planes are left to the ground that pictures have."""
    return [_block(body) for body in scene.environment if isinstance(body, Block)]


def _block(block: Block) -> Mesh:
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)]
    faces += [(0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    vertices = np.array(block.center) + (signs * block.half) @ block.axes.T
    return Mesh(vertices, np.array(faces, np.intp), (*RIGID, 1.0))


def target_shapes(target: Array) -> list[Shape]:
    """The target of the flange, (3,), m."""
    return [Sphere(target, 0.025, (*rgb(SKY_BLUE), 1.0))]


def path_shapes(points: Array, colour: str, radius: float = _PATH_RADIUS) -> list[Shape]:
    """A path, (n, 3), as capsules with a ball at its end; empty if it has no length."""
    solid = (*rgb(colour), 1.0)
    points = points[np.unique(np.linspace(0, len(points) - 1, _PATH_POINTS).astype(int))] if len(points) else points
    pieces: list[Shape] = [
        Capsule(start, end, radius, solid)
        for start, end in itertools.pairwise(points)
        if np.linalg.norm(end - start) > _SHORTEST
    ]
    return [*pieces, Sphere(points[-1], 1.6 * radius, solid)] if pieces else []


def floor(radius: float = 0.8) -> Cylinder:
    """The ground of pictures, a disc around the arm's base."""
    return Cylinder(np.array([0.0, 0.0, -0.02]), np.zeros(3), radius, (*_FLOOR, 1.0))


def _surface(obstacle: Obstacle, nodes: Array, colour: Colour) -> Mesh:
    """Surface of a lattice, outside its outer nodes by their radius, like that of the foam."""
    counts = obstacle.lattice
    index = np.arange(len(nodes)).reshape(counts)
    grid = np.stack(np.unravel_index(np.arange(len(nodes)), counts), axis=1)
    last = np.array(counts) - 1
    outwards = (grid == last).astype(float) - (grid == 0).astype(float)
    faces: list[Array] = []
    for axis in range(3):
        for side in (0, -1):
            sheet = np.take(index, side, axis=axis)
            a, b, c, d = (part.ravel() for part in (sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]))
            # The sheet's two axes, in order, turn about the third, except for the middle one.
            outward = (side == -1) == (axis != 1)
            corners: Sequence[Array] = (a, b, c, d) if outward else (a, d, c, b)
            faces.append(np.stack([corners[0], corners[1], corners[2]], axis=1))
            faces.append(np.stack([corners[0], corners[2], corners[3]], axis=1))
    return Mesh(nodes + obstacle.radius * outwards, np.concatenate(faces).astype(np.intp), colour)
