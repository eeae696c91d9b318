"""What a picture is made of, whatever draws it. Lengths in m, base frame; colours are (red, green, blue, opacity)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Colour = tuple[float, float, float, float]

_AROUND = 36
"""Corners of what is round, as a mesh."""
_FLATNESS = 0.02
"""By how much, as a share of the radius, its mesh may lie inside of it."""


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


Shape = Sphere | Capsule | Cylinder | Mesh


def corners(shape: Shape) -> Array:
    """Points (n, 3) whose convex hull holds the shape."""
    if isinstance(shape, Mesh):
        return shape.vertices
    ends = (shape.center,) if isinstance(shape, Sphere) else (shape.start, shape.end)
    offsets = shape.radius * np.concatenate([np.eye(3), -np.eye(3)])
    return np.concatenate([end + offsets for end in ends])


def move(shape: Shape, rotation: Array, origin: Array) -> Shape:
    """The shape, given in a frame with axes `rotation` (3, 3) and `origin` (3,), in the base frame."""
    if isinstance(shape, Mesh):
        return replace(shape, vertices=shape.vertices @ rotation.T + origin)
    if isinstance(shape, Sphere):
        return replace(shape, center=rotation @ shape.center + origin)
    return replace(shape, start=rotation @ shape.start + origin, end=rotation @ shape.end + origin)


def revolve(start: ArrayLike, end: ArrayLike, profile: ArrayLike, colour: Colour, around: int = _AROUND) -> Mesh:
    """A body of revolution about the axis from `start` to `end`.

    Parameters
    ----------
    start, end
        (3,) and not equal.
    profile
        (n, 2) of height above `start`, in m and not decreasing, and radius there.
    colour
        Of the mesh.
    around
        Corners of a circle.
    """
    start, profile = np.asarray(start, float), np.asarray(profile, float)
    axis = np.asarray(end, float) - start
    axis /= np.linalg.norm(axis)
    first, second = _perpendicular(axis)
    angles = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    circle = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    rings = start + profile[:, None, :1] * axis + profile[:, None, 1:] * circle
    return _skin(rings, colour)


def tube(points: Array, radius: float, colour: Colour, around: int = 10) -> Mesh:
    """A tube along `points` (n, 3), of which at least two differ."""
    points = points[np.append(True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9)]
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angles = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    first, _ = _perpendicular(tangents[0])
    rings = np.empty((len(points), around, 3))
    for index, (point, tangent) in enumerate(zip(points, tangents, strict=True)):
        # Carried along from ring to ring, so that the tube does not twist.
        first = first - (first @ tangent) * tangent
        first /= np.linalg.norm(first)
        second = np.cross(tangent, first)
        rings[index] = point + radius * (np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second)
    return _skin(rings, colour)


def as_mesh(shape: Shape) -> Mesh:
    """The shape as triangles."""
    if isinstance(shape, Mesh):
        return shape
    start, axis, length = _axis(shape)
    # Short pieces, since what lies in front of what is decided for each by its centre.
    along = np.linspace(0.0, length, max(1, int(np.ceil(3.0 * length / shape.radius))) + 1)
    outwards = np.linspace(0.0, 1.0, 9)[:-1]
    if isinstance(shape, Cylinder):
        low, high, bulge = 0.0 * outwards, length + 0.0 * outwards, outwards
    else:
        low = -np.sqrt(1.0 - np.sin(0.5 * np.pi * outwards) ** 2) * shape.radius
        high, bulge = length - low, np.sin(0.5 * np.pi * outwards)
    heights = np.concatenate([low, along, high[::-1]])
    radii = shape.radius * np.concatenate([bulge, np.ones(len(along)), bulge[::-1]])
    return revolve(start, start + axis, np.stack([heights, radii], axis=1), shape.colour)


def inside(shape: Shape, points: Array) -> NDArray[np.bool_]:
    """Which of `points` (n, 3) lie within the shape and not on its surface; of a mesh, none."""
    if isinstance(shape, Mesh):
        return np.zeros(len(points), bool)
    start, axis, length = _axis(shape)
    along = (points - start) @ axis
    nearest = start + np.clip(along, 0.0, length)[:, None] * axis
    distance = np.linalg.norm(points - nearest, axis=1)
    # The mesh of what is round lies inside by a little.
    within = distance < (1.0 - _FLATNESS) * shape.radius
    if isinstance(shape, Cylinder):
        skin = _FLATNESS * shape.radius
        within &= (along > skin) & (along < length - skin)
    return within


def _axis(shape: Sphere | Capsule | Cylinder) -> tuple[Array, Array, float]:
    """Where it starts, its direction, a unit vector, and its length."""
    if isinstance(shape, Sphere):
        return shape.center, np.array([0.0, 0.0, 1.0]), 0.0
    length = float(np.linalg.norm(shape.end - shape.start))
    return shape.start, (shape.end - shape.start) / length, length


def _perpendicular(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with a unit axis as its third."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _skin(rings: Array, colour: Colour) -> Mesh:
    """Closed mesh over rings (n, m, 3) of points, which turn counterclockwise as seen from the last one."""
    count, around = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[:1].mean(axis=1), rings[-1:].mean(axis=1)])
    here = np.arange(around)
    there = np.roll(here, -1)
    faces = []
    for ring in range(count - 1):
        low, high = ring * around, (ring + 1) * around
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    bottom, top = count * around, count * around + 1
    faces.append(np.stack([there, here, np.full(around, bottom)], axis=1))
    last = (count - 1) * around
    faces.append(np.stack([last + here, last + there, np.full(around, top)], axis=1))
    return Mesh(vertices, np.concatenate(faces), colour)
