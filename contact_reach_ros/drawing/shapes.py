"""The shapes that make up pictures. Lengths in m, base frame; colours are (red, green, blue, opacity)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array

Indices = NDArray[np.intp]
Colour = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere around `center` (3,)."""

    center: Array
    radius: float
    colour: Colour


@dataclass(frozen=True, eq=False)
class Capsule:
    """The segment from `start` (3,) to `end` (3,), not empty, thickened by `radius`."""

    start: Array
    end: Array
    radius: float
    colour: Colour


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder about the axis from `start` (3,) to `end` (3,)."""

    start: Array
    end: Array
    radius: float
    colour: Colour


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: `vertices` (V, 3) and `faces` (F, 3), counterclockwise as seen from outside."""

    vertices: Array
    faces: Indices
    colour: Colour


Solid = Sphere | Capsule | Cylinder
Shape = Solid | Mesh


def corners(shape: Shape) -> Array:
    """Points (n, 3) whose convex hull holds the shape."""
    if isinstance(shape, Mesh):
        return shape.vertices
    ends = (shape.center,) if isinstance(shape, Sphere) else (shape.start, shape.end)
    offsets = shape.radius * np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([end + offsets for end in ends])


def move(shape: Shape, rotation: Array, origin: Array) -> Shape:
    """Transform a shape from a frame with axes `rotation` (3, 3) and `origin` (3,) to the base frame."""
    if isinstance(shape, Mesh):
        return replace(shape, vertices=shape.vertices @ rotation.T + origin)
    if isinstance(shape, Sphere):
        return replace(shape, center=rotation @ shape.center + origin)
    return replace(shape, start=rotation @ shape.start + origin, end=rotation @ shape.end + origin)
