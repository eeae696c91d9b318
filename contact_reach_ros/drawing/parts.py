"""The arm's links as shapes, and the colours of what pictures show."""

from __future__ import annotations

import functools

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.drawing.shapes import Capsule, Cylinder, Solid, Sphere

BODY = (0.86, 0.87, 0.88)
_ACCENT = (0.95, 0.45, 0.1)
DARK = (0.22, 0.23, 0.25)
FOAM = (0.42, 0.8, 0.58)
NODE = (0.1, 0.55, 0.35)
RIGID = (0.6, 0.58, 0.55)
_COVER_RADIUS = 0.62
"""Radius of a joint's cover, in radii of the link."""


@functools.cache
def link_shapes(arm: Arm) -> tuple[tuple[Solid, ...], ...]:
    """Shapes of the base, then of each link in its own frame; empty for a link without a capsule.

    Joints that bend the arm have covers.
    """
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
