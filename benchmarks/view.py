"""What pictures show, as shapes, and the camera that sees it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.drawing.palette import SKY_BLUE, rgb
from contact_reach_ros.drawing.parts import DARK, FOAM, NODE, RIGID, link_shapes
from contact_reach_ros.drawing.shapes import Capsule, Colour, Cylinder, Mesh, Shape, Sphere, corners, move
from contact_reach_ros.world.obstacle import Obstacle
from contact_reach_ros.world.rigid import Block
from contact_reach_ros.world.scene import Scene
from contact_reach_ros.world.spheres import by_obstacle

FRONT_SIDE = (0.75, -1.0, 0.5)
"""Direction to the camera: the arm reaches to the right and towards the viewer."""

SIDE = (0.45, -1.0, 0.22)
"""Direction to a camera that is lower and more to the side, along walls that stand across the arm's way."""

_FIELD_OF_VIEW = np.radians(28.0)
"""Vertical field of view: a long lens, so that near parts do not look larger than they are."""

_FLOOR = (0.93, 0.93, 0.93)
_PATH_RADIUS = 0.008
_PATH_POINTS = 120
_SHORTEST = 1e-6
"""Shortest piece of a path that has a direction, m."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes
    ----------
    eye
        (3,) position, m, base frame.
    axes
        (3, 3) unit vectors to the right, up and back, as rows.
    width, height
        Size of the picture, pixels.
    """

    eye: Array
    axes: Array
    width: int
    height: int

    @property
    def field_of_view(self) -> float:
        """Vertical field of view, rad."""
        return float(_FIELD_OF_VIEW)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Project points (..., 3) to pixels (..., 2), right and up from the lower left corner, and depths (...), m."""
        seen = (points - self.eye) @ self.axes.T
        depth = -seen[..., 2]
        scale = 0.5 * self.height / np.tan(0.5 * self.field_of_view)
        return scale * seen[..., :2] / depth[..., None] + 0.5 * np.array([self.width, self.height]), depth


def frame(
    shapes: Iterable[Shape], width: int, height: int, direction: ArrayLike = FRONT_SIDE, margin: float = 0.04
) -> Camera:
    """The nearest camera in a direction that sees all of the shapes.

    Parameters
    ----------
    shapes
        Shapes to show, at least one.
    width, height
        Size of the picture, pixels.
    direction
        (3,) direction to the camera, not vertical.
    margin
        Space to leave free on each side, as a share of the picture.
    """
    back = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    points = np.concatenate([corners(shape) for shape in shapes]) @ axes.T
    slope = (1.0 - 2.0 * margin) * np.tan(0.5 * _FIELD_OF_VIEW)
    eye = np.array([0.0, 0.0, -np.inf])
    for axis, tangent in enumerate((slope * width / height, slope)):
        # |x - eye_x| <= tangent (eye_z - z) for each point.
        above = (points[:, axis] + tangent * points[:, 2]).max()
        below = (tangent * points[:, 2] - points[:, axis]).max()
        eye[axis] = 0.5 * (above - below)
        eye[2] = max(eye[2], 0.5 * (above + below) / tangent)
    return Camera(eye @ axes, axes, width, height)


@dataclass(frozen=True, eq=False)
class View:
    """Shapes and the camera that sees them.

    Attributes
    ----------
    shapes
        Shapes, which may overlap.
    camera
        Camera; also sets the size of the picture.
    floor
        Floor below all shapes.
    """

    shapes: Sequence[Shape]
    camera: Camera
    floor: Cylinder | None = None


def arm_shapes(arm: Arm, q: ArrayLike) -> list[Shape]:
    """The arm's collision capsules at the joint angles (n,), rad, with covers at the joints, and its base."""
    rotations, origins = link_frames(arm, q)
    base, *links = link_shapes(arm)
    shapes: list[Shape] = list(base)
    for link, solids in enumerate(links):
        shapes += [move(solid, rotations[link], origins[link]) for solid in solids]
    return shapes


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
