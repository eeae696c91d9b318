"""One picture that is to be made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from contact_reach_ros.rendering.camera import Camera
from contact_reach_ros.rendering.shapes import Cylinder, Shape

LIGHT = np.array([0.25, -0.4, 0.88]) / np.linalg.norm([0.25, -0.4, 0.88])
"""Unit vector towards the light, base frame."""


@dataclass(frozen=True, eq=False)
class Ghost:
    """What is shown faintly as a whole, opacity in (0, 1], whatever parts of it overlap."""

    shapes: Sequence[Shape]
    opacity: float


@dataclass(frozen=True, eq=False)
class View:
    """What is to be seen, and the camera that looks at it.

    Attributes
    ----------
    shapes
        In front of, behind and inside each other.
    camera
        Its picture is as large as it says.
    floor
        Below all shapes.
    ghosts
        Hidden by the shapes in front of them, but not by each other.
    """

    shapes: Sequence[Shape]
    camera: Camera
    floor: Cylinder | None = None
    ghosts: Sequence[Ghost] = ()
