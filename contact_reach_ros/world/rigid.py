"""Rigid bodies around the arm, which it must not touch: planes with everything behind them, and blocks."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contact_reach_ros.arm import Array, checked_array, quaternion_from_rotation, rotation_from_quaternion
from contact_reach_ros.arm.rotations import frame_about
from contact_reach_ros.errors import InputError

Vector = Sequence[float] | Array
"""Becomes a tuple, so that bodies can be compared."""


@dataclass(frozen=True)
class Plane:
    """A plane and everything behind it: a floor, a wall, a ceiling.

    Raises
    ------
    InputError
        If a value is not finite, or the normal has no direction.
    """

    name: str
    """In messages to the user, such as 'floor'."""
    point: Vector = (0.0, 0.0, 0.0)
    """Anywhere on the plane, m, base frame."""
    normal: Vector = (0.0, 0.0, 1.0)
    """Direction in which the arm is; it is made a unit vector."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", _checked(self.name, "point", self.point, 3))
        normal = np.array(_checked(self.name, "normal", self.normal, 3))
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            raise InputError(f"{self.name}: normal = {list(self.normal)}; expected a vector that points to the arm")
        object.__setattr__(self, "normal", tuple((normal / length).tolist()))

    @property
    def offset(self) -> float:
        """Distance of the plane from the origin along its normal, m."""
        return float(np.dot(self.normal, self.point))

    def moved(self, rotation: Array, origin: Array) -> Plane:
        """The plane of another frame, which has a rotation (3, 3) and an origin (3,), m, in the base frame."""
        return Plane(self.name, rotation @ self.point + origin, rotation @ self.normal)


@dataclass(frozen=True)
class Block:
    """A rigid box: a table top, a shelf, a pedestal.

    Raises
    ------
    InputError
        If a value is not finite, a side is not positive or the quaternion has not unit length.
    """

    name: str
    """In messages to the user, such as 'table'."""
    center: Vector
    """m, base frame."""
    size: Vector
    """Lengths of its sides along its own axes, m."""
    orientation: Vector = (0.0, 0.0, 0.0, 1.0)
    """Of its axes in the base frame, unit quaternion x, y, z, w."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _checked(self.name, "center", self.center, 3))
        object.__setattr__(self, "size", _checked(self.name, "size", self.size, 3))
        if min(self.size) <= 0.0:
            raise InputError(f"{self.name}: size = {list(self.size)}; expected positive lengths in m")
        quaternion = np.array(_checked(self.name, "orientation", self.orientation, 4))
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > 0.01:
            raise InputError(
                f"{self.name}: orientation = {list(self.orientation)}; expected a unit quaternion x, y, z, w"
            )
        object.__setattr__(self, "orientation", tuple((quaternion / length).tolist()))

    @property
    def axes(self) -> Array:
        """(3, 3) its axes in the base frame, one a column."""
        return rotation_from_quaternion(np.roll(self.orientation, 1))

    @property
    def half(self) -> Array:
        """(3,) half of its size, m."""
        return 0.5 * np.array(self.size)

    def moved(self, rotation: Array, origin: Array) -> Block:
        """As `Plane.moved`."""
        return Block(self.name, rotation @ self.center + origin, self.size, _orientation(rotation @ self.axes))


RigidBody = Plane | Block
Environment = tuple[RigidBody, ...]
"""Everything rigid around the arm."""


def point_distances(environment: Environment, points: Array) -> Array:
    """Distances (B, ...) of points (..., 3) from the surface of each body, m; negative inside."""
    planes, normals, offsets, blocks, centers, axes, halves = _stacked(environment)
    flat = points.reshape(-1, 3)
    distances = np.empty((len(environment), len(flat)))
    if len(planes):
        distances[planes] = normals @ flat.T - offsets
    if len(blocks):
        beyond = np.abs((flat - centers) @ axes) - halves
        outside = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=-1))
        distances[blocks] = outside + np.minimum(beyond.max(axis=-1), 0.0)
    return distances.reshape(len(environment), *points.shape[:-1])


@functools.lru_cache(maxsize=256)
def _stacked(environment: Environment) -> tuple[Array, ...]:
    """Index, normal and offset of the planes; index, center, axes and half size of the blocks."""
    planes = [(index, body) for index, body in enumerate(environment) if isinstance(body, Plane)]
    blocks = [(index, body) for index, body in enumerate(environment) if isinstance(body, Block)]
    return (
        np.array([index for index, _ in planes], int),
        np.array([plane.normal for _, plane in planes]),
        np.array([[plane.offset] for _, plane in planes]),
        np.array([index for index, _ in blocks], int),
        np.array([[block.center] for _, block in blocks]),
        np.array([block.axes for _, block in blocks]),
        np.array([[block.half] for _, block in blocks]),
    )


_SLAB = (3.0, 3.0, 0.02)
"""Size of what stands for a plane in pictures, m."""


def slab(body: RigidBody) -> Block:
    """What shows a body: the block itself, or a slab around the plane's point nearest to the base, under the plane."""
    if isinstance(body, Block):
        return body
    normal = np.array(body.normal)
    center = (body.offset - 0.5 * _SLAB[2]) * normal
    return Block(body.name, center, _SLAB, _orientation(frame_about(normal)))


def _orientation(axes: Array) -> Array:
    """(4,) quaternion x, y, z, w of axes (3, 3)."""
    return np.roll(quaternion_from_rotation(axes), -1)


def _checked(body: str, name: str, values: object, count: int) -> tuple[float, ...]:
    return tuple(checked_array(f"{body}: {name}", values, (count,)).tolist())
