"""The capsules of an arm that is read from a URDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from contact_reach_ros.arm.arm import Capsule, Joint, Vector3
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.capsule_fit import Fit, fit_capsule
from contact_reach_ros.arm.collision_shapes import shape_balls
from contact_reach_ros.arm.kinematics import rotation_about, rotation_from_quaternion
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.arm.urdf_tree import UrdfTree
from contact_reach_ros.errors import SettingsError

_SWEEP = 12
"""Angles of the first joint at which its link is part of the base's capsule."""
_WIDE = 1.3
"""Factor on the radius of the base's capsule up to which the swept first link belongs to it."""


class Part(NamedTuple):
    """A moving link, or the base, with all that is fixed to it."""

    link: str
    turn: Array
    """(4, 4) of the frame that turns about its z axis in the link's own."""
    places: dict[str, Array]
    """Frames (4, 4) of the link and those that are fixed to it in the link's own."""


class LinkCapsules(NamedTuple):
    """Capsules of base and links, and how they were found."""

    base: Capsule
    links: tuple[Capsule, ...]
    fits: dict[str, Fit]
    """Those that were fitted, by link."""
    bare: list[str]
    """Moving links without collision geometry, which have none."""
    geometry: list[list[Array]]
    """What they were fitted to: of the base and each link, the balls (N, 4) of each shape in the link's frame, m."""


def link_capsules(tree: UrdfTree, file: Path, options: ArmOptions, parts: Sequence[Part], first: Joint) -> LinkCapsules:
    """Find the capsules of the base and the moving links: given ones, or one around all collision geometry of a link.

    The base's stands upright. A first link that only turns about the base's axis is part of it, unless that would make
    it much wider.

    Parameters
    ----------
    tree, file, options
        The URDF, its path, and what it leaves open.
    parts
        The base, then the moving links.
    first
        The first joint.

    Raises
    ------
    SettingsError
        If a mesh cannot be read, or the base or all moving links have neither collision geometry nor given capsules.
    """
    given = [_given(options, number, part) for number, part in enumerate(parts)]
    geometry = [
        _balls(tree, file, options, part) if own is None else [] for own, part in zip(given, parts, strict=True)
    ]
    shapes = [np.concatenate([np.zeros((0, 4)), *balls]) for balls in geometry]
    fits: dict[str, Fit] = {}
    begin, base = 1, given[0][0] if given[0] else None
    if base is None:
        upright = np.array([0.0, 0.0, 1.0])
        fit = fit_capsule(shapes[0], upright) if len(shapes[0]) else None
        swept = _swept(first, shapes[1])
        if len(swept):
            wide = fit_capsule(np.concatenate([shapes[0], swept]), upright)
            if fit is None or wide.radius <= _WIDE * fit.radius:
                begin, fit = 2, wide
        if fit is None:
            raise SettingsError(
                f"{file}: base '{parts[0].link}' has no collision geometry; expected some in the URDF, or a capsule "
                f"under capsules ({{{parts[0].link}: [{{start: ..., end: ..., radius: ...}}]}})"
            )
        fits[parts[0].link], base = fit, _capsule(0, fit)
    capsules: list[Capsule] = []
    bare = []
    for number in range(begin, len(parts)):
        own, link = given[number], parts[number].link
        if own is not None:
            capsules += own
        elif len(shapes[number]):
            fits[link] = fit_capsule(shapes[number])
            capsules.append(_capsule(number, fits[link]))
        else:
            bare.append(link)
    if not capsules:
        raise SettingsError(
            f"{file}: no moving link has collision geometry; expected some in the URDF, or some under capsules"
        )
    return LinkCapsules(base, tuple(capsules), fits, bare, geometry)


def vector(values: Array) -> Vector3:
    """Three numbers as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def _given(options: ArmOptions, number: int, part: Part) -> list[Capsule] | None:
    """The capsules of a part that the options have, in its turned frame; None if they say nothing about it."""
    found = None
    for name, place in part.places.items():
        if name in options.capsules:
            found = found or []
            to_part = part.turn.T @ place
            for each in options.capsules[name]:
                start, end = (vector(to_part[:3, :3] @ point + to_part[:3, 3]) for point in (each.start, each.end))
                found.append(Capsule(number, start, end, each.radius))
    return found


def _balls(tree: UrdfTree, file: Path, options: ArmOptions, part: Part) -> list[Array]:
    """The collision shapes of a part as balls (N, 4), in its turned frame."""
    found = []
    for name, place in part.places.items():
        to_part = part.turn.T @ place
        for shape in tree.links[name].shapes:
            balls = shape_balls(shape, file, options.packages, f"{file}: link '{name}'")
            found.append(_moved(balls, to_part[:3, :3], to_part[:3, 3]))
    return found


def _swept(first: Joint, balls: Array) -> Array:
    """The first link's balls at all angles of its joint, in the base's frame; none if that turns about another axis."""
    at_zero = rotation_from_quaternion(first.rotation)
    if at_zero[2, 2] < 1.0 - 1e-9 or math.hypot(*first.offset[:2]) > 1e-6:
        return balls[:0]
    turns = [rotation_about((0.0, 0.0, 1.0), angle) for angle in np.linspace(0.0, 2.0 * np.pi, _SWEEP, endpoint=False)]
    return np.concatenate([_moved(balls, at_zero @ turn, np.array(first.offset)) for turn in turns])


def _moved(balls: Array, rotation: Array, offset: Array) -> Array:
    return np.column_stack([balls[:, :3] @ rotation.T + offset, balls[:, 3]])


def _capsule(link: int, fit: Fit) -> Capsule:
    """In tenths of a millimetre; what fits stays inside."""
    start, end = (vector(np.round(point, 4)) for point in (fit.start, fit.end))
    return Capsule(link, start, end, round(math.ceil(1e4 * fit.radius) / 1e4 + 1e-4, 4))
