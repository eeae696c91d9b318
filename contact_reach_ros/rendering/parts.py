"""The arm, the obstacles and what happens to them, as shapes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_reach_ros.palette import SKY_BLUE, rgb
from contact_reach_ros.rendering.shapes import Capsule, Colour, Cylinder, Mesh, Shape, Sphere, move, tube
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.scenes.scene import Scene, Wall

Array = NDArray[np.float64]

BODY = (0.86, 0.87, 0.88)
_ACCENT = (0.95, 0.45, 0.1)
DARK = (0.22, 0.23, 0.25)
FOAM = (0.42, 0.8, 0.58)
NODE = (0.1, 0.55, 0.35)
_FLOOR = (0.93, 0.93, 0.93)
_COVERED_JOINTS = (2, 4, 6)
_COVER_RADIUS = 0.62
"""Of a joint's cover, in radii of the link."""
_PATH_RADIUS = 0.008
_PATH_POINTS = 120


def arm_shapes(joints: ArrayLike, tint: str = "") -> list[Shape]:
    """The arm's collision capsules, with covers at the joints that bend it, and its base.

    Parameters
    ----------
    joints
        (7,) angles, rad.
    tint
        '#rrggbb' of the whole arm but its base, instead of its own colours.
    """
    rotations, origins = link_frames(joints)
    shapes = list(link_shapes()[0])
    for link, parts in enumerate(link_shapes()[1:]):
        for part in parts:
            moved = move(part, rotations[link], origins[link])
            shapes.append(dataclasses.replace(moved, colour=(*rgb(tint), 1.0)) if tint else moved)
    return shapes


@functools.cache
def link_shapes() -> tuple[tuple[Shape, ...], ...]:
    """The base, then the links, in the frame of each: what `arm_shapes` puts together. The first link has none."""
    base = iiwa14.BASE_CAPSULE
    ground, top = np.zeros(3), np.array(base.end)
    shapes: list[list[Shape]] = [[] for _ in range(iiwa14.N_JOINTS + 1)]
    shapes[0] = [
        Cylinder(ground, top, base.radius, (*BODY, 1.0)),
        Sphere(top, base.radius, (*BODY, 1.0)),
        Cylinder(ground, np.array([0.0, 0.0, 0.03]), 1.15 * base.radius, (*DARK, 1.0)),
    ]
    thickness = base.radius
    for capsule in iiwa14.CAPSULES:
        last = capsule.link == iiwa14.N_JOINTS
        start, end = np.array(capsule.start, float), np.array(capsule.end, float)
        shapes[capsule.link].append(Capsule(start, end, capsule.radius, (*(DARK if last else BODY), 1.0)))
        if capsule.link in _COVERED_JOINTS:
            half = np.array([0.0, 0.0, 1.04 * max(thickness, capsule.radius)])
            shapes[capsule.link].append(Cylinder(-half, half, _COVER_RADIUS * capsule.radius, (*_ACCENT, 1.0)))
        thickness = capsule.radius
    return tuple(map(tuple, shapes))


def obstacle_shapes(scene: Scene, positions: Array, opacity: float = 0.55) -> list[Shape]:
    """Balls, and walls as their nodes and the surface that these span.

    Parameters
    ----------
    scene
        Whose obstacles they are.
    positions
        (K, 3), m, in the order of `scenes.spheres.rest_positions`.
    opacity
        Of what one should see the arm through.
    """
    green = (*FOAM, opacity)
    shapes: list[Shape] = []
    for ball, center in zip(scene.balls, positions, strict=False):
        shapes.append(Sphere(center, ball.settings.radius, green))
    first = len(scene.balls)
    for wall in scene.walls:
        nodes = positions[first : first + len(wall.rest)]
        first += len(wall.rest)
        for node, fixed in zip(nodes, wall.fixed, strict=True):
            colour = (*DARK, 1.0) if fixed else (*NODE, 1.0)
            shapes.append(Sphere(node, 0.5 * wall.settings.node_radius, colour))
        shapes.append(_surface(wall, nodes, green))
    return shapes


def target_shapes(target: Array) -> list[Shape]:
    """Where the flange should go, (3,)."""
    return [Sphere(target, 0.025, (*rgb(SKY_BLUE), 1.0))]


def path_shapes(points: Array, colour: str, radius: float = _PATH_RADIUS) -> list[Shape]:
    """A path, (n, 3), as a tube; nothing if it has no length."""
    points = points[np.unique(np.linspace(0, len(points) - 1, _PATH_POINTS).astype(int))] if len(points) else points
    if len(points) < 2 or not np.ptp(points, axis=0).any():
        return []
    return [tube(points, radius, (*rgb(colour), 1.0)), Sphere(points[-1], 1.6 * radius, (*rgb(colour), 1.0))]


def floor(radius: float = 0.8) -> Cylinder:
    """The ground that the arm stands on, a disc around its base."""
    return Cylinder(np.array([0.0, 0.0, -0.02]), np.zeros(3), radius, (*_FLOOR, 1.0))


def _surface(wall: Wall, nodes: Array, colour: Colour) -> Mesh:
    """Surface of a wall, farther out than its outer nodes by their radius, as the foam is."""
    counts = wall.settings.nodes
    index = np.arange(len(nodes)).reshape(counts)
    grid = np.stack(np.unravel_index(np.arange(len(nodes)), counts), axis=1)
    last = np.array(counts) - 1
    outwards = (grid == last).astype(float) - (grid == 0).astype(float)
    faces: list[Array] = []
    for axis in range(3):
        for side in (0, -1):
            sheet = np.take(index, side, axis=axis)
            a, b, c, d = (part.ravel() for part in (sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]))
            # The sheet's two axes, in their order, turn about the third but for the middle one.
            outward = (side == -1) == (axis != 1)
            corners: Sequence[Array] = (a, b, c, d) if outward else (a, d, c, b)
            faces.append(np.stack([corners[0], corners[1], corners[2]], axis=1))
            faces.append(np.stack([corners[0], corners[2], corners[3]], axis=1))
    return Mesh(nodes + wall.settings.node_radius * outwards, np.concatenate(faces).astype(np.intp), colour)
