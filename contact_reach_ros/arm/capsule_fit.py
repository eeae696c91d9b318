"""The smallest capsule around the collision shapes of a link.

Shapes are sets of balls, (N, 4) with centre and radius each, whose convex hull covers them: a mesh is its vertices, a
sphere one ball, a capsule two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

from contact_reach_ros.arm.arm import Array
from contact_reach_ros.arm.capsules import volume
from contact_reach_ros.arm.rotations import frame_about

POOR = 2.5
"""Volume of a capsule, in those of its shapes' convex hull, above which it is a poor fit."""
_WIDE = 0.1
"""Radius above which a poor fit is worth several capsules, m."""
_CUTS = 3
"""Times that shapes are cut in halves at most."""
_SMALLER = 0.75
"""Share of a capsule's volume below which several replace it."""
_SHORTEST = 1e-3
"""Least length of a capsule's segment, m: it needs a direction."""
_SPIRAL = 500
"""Points that stand for a sphere in the volume of shapes."""


@dataclass(frozen=True)
class Fit:
    """A capsule around shapes, and how much larger it is."""

    start: Array
    """(3,), m."""
    end: Array
    """(3,), m."""
    radius: float
    """m."""
    volume_ratio: float
    """Volume of the capsule by that of the shapes' convex hull; infinite for shapes that are flat."""

    @property
    def volume(self) -> float:
        """Of the capsule, m³."""
        return volume(self.start, self.end, self.radius)


def cover(balls: Array, cuts: int = _CUTS) -> list[Fit]:
    """Capsules around `balls` (N, 4), m: one, or of a plate or block, where it is wide and a poor fit, one a slice."""
    fit = fit_capsule(balls)
    if not POOR < fit.volume_ratio < math.inf or fit.radius <= _WIDE or not cuts or balls[:, 3].any():
        return [fit]
    points = balls[:, :3]
    axis = frame_about(fit.end - fit.start)
    # Along the capsule, and across where the shapes are wider.
    flat = (points - points.mean(axis=0)) @ axis[:, :2]
    width = flat @ np.linalg.svd(flat, full_matrices=False)[2][0]
    height = width - 0.5 * (width.min() + width.max())
    edges = np.concatenate([ConvexHull(points).simplices[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    first, second = edges[np.prod(height[edges], axis=1) < 0.0].T
    share = (height[first] / (height[first] - height[second]))[:, None]
    cut = points[first] + share * (points[second] - points[first])
    slices = (np.concatenate([points[side], cut]) for side in (height <= 0.0, height >= 0.0))
    fits = [one for part in slices for one in cover(np.column_stack([part, np.zeros(len(part))]), cuts - 1)]
    return fits if sum(one.volume for one in fits) < _SMALLER * fit.volume else [fit]


def fit_capsule(balls: Array, on_axis: bool = False) -> Fit:
    """The capsule of least volume around `balls` (N, 4), m; with its segment on the z axis if `on_axis`."""
    center = np.zeros(3) if on_axis else 0.5 * (balls[:, :3].min(axis=0) + balls[:, :3].max(axis=0))
    size = float(np.ptp(balls[:, :3], axis=0).max()) + float(balls[:, 3].max()) + _SHORTEST
    principal = np.linalg.svd(balls[:, :3] - balls[:, :3].mean(axis=0), full_matrices=False)[2]
    frames = [np.eye(3)] if on_axis else [frame_about(axis) for axis in principal]
    points, radii = balls[:, :3] - center, balls[:, 3]

    def capsule(values: Array, frame: Array) -> tuple[Array, Array, float]:
        """Widened, and, unless it is on the axis, tilted and shifted in two directions, in units of the size."""
        widened, *aside = values
        tilt, shift = (aside[:2], size * np.array(aside[2:])) if aside else ((0.0, 0.0), np.zeros(2))
        turned = frame_about(frame @ (*tilt, 1.0)) if aside else frame
        local = points @ turned
        distance = np.hypot(local[:, 0] - shift[0], local[:, 1] - shift[1])
        radius = float((distance + radii).max()) * (1.0 + abs(widened))
        along = np.sqrt(np.maximum((radius - radii) ** 2 - distance**2, 0.0))
        low, high = float((local[:, 2] + along).min()), float((local[:, 2] - along).max())
        if high - low < _SHORTEST:
            low, high = 0.5 * (low + high - _SHORTEST), 0.5 * (low + high + _SHORTEST)
        offset = turned[:, :2] @ shift + center
        return offset + low * turned[:, 2], offset + high * turned[:, 2], radius

    def size_of(values: Array, frame: Array) -> float:
        return volume(*capsule(values, frame)) / size**3

    variables = 1 if on_axis else 5
    simplex = np.vstack([np.zeros(variables), 0.1 * np.eye(variables)])
    options = {"initial_simplex": simplex, "xatol": 5e-4, "fatol": 1e-6, "maxiter": 600}
    found = [(minimize(size_of, simplex[0], (frame,), "Nelder-Mead", options=options), frame) for frame in frames]
    best, frame = min(found, key=lambda pair: pair[0].fun)
    return _judged(*capsule(best.x, frame), balls)


def _judged(start: Array, end: Array, radius: float, balls: Array) -> Fit:
    # Points on a spiral around the unit sphere.
    height = np.linspace(-1.0, 1.0, _SPIRAL)
    turn, width = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(_SPIRAL), np.sqrt(1.0 - height**2)
    unit = np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)
    points = [ball[:3] + ball[3] * unit if ball[3] > 0.0 else ball[None, :3] for ball in balls]
    try:
        bare = float(ConvexHull(np.concatenate(points)).volume)
    except QhullError:
        return Fit(start, end, radius, math.inf)
    return Fit(start, end, radius, volume(start, end, radius) / bare)
