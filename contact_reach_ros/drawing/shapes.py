"""The shapes that make up pictures. Lengths in m, base frame; colours are (red, green, blue, opacity)."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.arm.arrays import Array

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


Solid = Sphere | Capsule | Cylinder
