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

from contact_reach_ros.arm.arrays import Array

_SHORTEST = 1e-3
"""Least length of a capsule's segment, m: it needs a direction."""
_ROUGH = 0.01
"""Share of a radius by which the polygon around a cylinder may stand out of the spheres at its ends."""
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
    """Volume of the capsule by that of the shapes' convex hull; NaN for shapes that are flat."""


def fit_capsule(balls: Array, direction: Array | None = None) -> Fit:
    """The capsule of least volume around `balls` (N, 4), m; with its axis along `direction` (3,) if that is given."""
    balls = _outer(balls)
    if len(balls) <= 2 and np.ptp(balls[:, 3]) == 0.0 and direction is None:
        # A sphere or a capsule already.
        return _judged(balls[0, :3], balls[-1, :3], float(balls[0, 3]), balls)
    center = 0.5 * (balls[:, :3].min(axis=0) + balls[:, :3].max(axis=0))
    size = float(np.ptp(balls[:, :3], axis=0).max()) + float(balls[:, 3].max())
    principal = np.linalg.svd(balls[:, :3] - balls[:, :3].mean(axis=0))[2]
    frames = [frame_about(axis) for axis in (principal if direction is None else [direction])]

    def capsule(frame: Array, values: Array) -> tuple[Array, Array, float]:
        """Of an axis shifted by two distances, in units of the size, widened, and tilted in two directions."""
        turned = frame if direction is not None else frame_about(frame @ (values[3], values[4], 1.0))
        local = (balls[:, :3] - center) @ turned
        aside = np.hypot(local[:, 0] - size * values[0], local[:, 1] - size * values[1])
        radius = float((aside + balls[:, 3]).max()) * (1.0 + abs(values[2]))
        along = np.sqrt(np.maximum((radius - balls[:, 3]) ** 2 - aside**2, 0.0))
        low, high = float((local[:, 2] + along).min()), float((local[:, 2] - along).max())
        if high - low < _SHORTEST:
            low, high = 0.5 * (low + high - _SHORTEST), 0.5 * (low + high + _SHORTEST)
        offset = turned[:, :2] @ (size * values[:2]) + center
        return offset + low * turned[:, 2], offset + high * turned[:, 2], radius

    def volume(values: Array, frame: Array) -> float:
        return _volume(*capsule(frame, values)) / size**3

    variables = 3 if direction is not None else 5
    simplex = np.vstack([np.zeros(variables), 0.1 * np.eye(variables)])
    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-7, "maxiter": 600}
    found = [(minimize(volume, simplex[0], (frame,), "Nelder-Mead", options=options), frame) for frame in frames]
    best, frame = min(found, key=lambda pair: pair[0].fun)
    return _judged(*capsule(frame, best.x), balls)


def _judged(start: Array, end: Array, radius: float, balls: Array) -> Fit:
    if np.linalg.norm(end - start) < _SHORTEST:
        end = start + np.array([0.0, 0.0, _SHORTEST])
    # Points on a spiral around the unit sphere.
    height = np.linspace(-1.0, 1.0, _SPIRAL)
    turn, width = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(_SPIRAL), np.sqrt(1.0 - height**2)
    unit = np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)
    points = [ball[:3] + ball[3] * unit if ball[3] > 0.0 else ball[None, :3] for ball in balls]
    try:
        bare = float(ConvexHull(np.concatenate(points)).volume)
    except QhullError:
        bare = math.nan
    return Fit(start, end, radius, _volume(start, end, radius) / bare)


def _volume(start: Array, end: Array, radius: float) -> float:
    """Of a capsule, m³."""
    return math.pi * radius**2 * (float(np.linalg.norm(end - start)) + 4.0 / 3.0 * radius)


def _outer(balls: Array) -> Array:
    """The balls that the convex hull needs: neither inside others, nor inside the capsule that two equal ones span."""
    round_ = balls[balls[:, 3] > 0.0]
    keep = np.ones(len(balls), bool)
    for first in round_:
        for second in round_:
            if first[3] == second[3]:
                axis = second[:3] - first[:3]
                share = (balls[:, :3] - first[:3]) @ axis / max(float(axis @ axis), 1e-12)
                nearest = first[:3] + np.clip(share, 0.0, 1.0)[:, None] * axis
                depth = first[3] - balls[:, 3] - np.linalg.norm(balls[:, :3] - nearest, axis=1)
                own = (balls == first).all(axis=1) | (balls == second).all(axis=1)
                keep &= (depth < -_ROUGH * first[3]) | own
    balls = np.unique(balls[keep], axis=0)
    if len(balls) > 8 and not balls[:, 3].any():
        try:
            return balls[ConvexHull(balls[:, :3]).vertices]
        except QhullError:
            pass
    return balls


def frame_about(axis: Array) -> Array:
    """The smallest rotation (3, 3) that turns z into the direction of `axis` (3,); exact for ±x, ±y and ±z."""
    x, y, z = axis / np.linalg.norm(axis)
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    share = 1.0 / (1.0 + z)
    return np.array([[1.0 - share * x * x, -share * x * y, x], [-share * x * y, 1.0 - share * y * y, y], [-x, -y, z]])
