"""The camera of a picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arrays import Array
from contact_reach_ros.drawing.shapes import Shape, corners

FRONT_SIDE = (0.75, -1.0, 0.5)
"""Direction to the camera: the arm reaches to the right and towards the viewer."""

SIDE = (0.45, -1.0, 0.22)
"""Direction to a camera that is lower and more to the side, along walls that stand across the arm's way."""

_FIELD_OF_VIEW = np.radians(28.0)
"""Vertical field of view: a long lens, so that near parts do not look larger than they are."""


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
