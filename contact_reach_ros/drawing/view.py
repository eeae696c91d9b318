"""Content of a picture and the camera that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from contact_reach_ros.drawing.camera import Camera
from contact_reach_ros.drawing.shapes import Cylinder, Shape


@dataclass(frozen=True, eq=False)
class View:
    """Shapes and the camera that sees them.

    Attributes
    ----------
    shapes
        Shapes, which may overlap.
    camera
        Camera; also sets the size of the picture.
    floor
        Floor below all shapes.
    """

    shapes: Sequence[Shape]
    camera: Camera
    floor: Cylinder | None = None
