"""Balls and colours for viser, which sends a property to the browsers only when its value changes."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from contact_reach_ros.drawing.palette import ORANGE, VERMILION, rgb
from contact_reach_ros.drawing.parts import BODY

Rgb = tuple[int, int, int]

_SHARES = (0.0, 0.5, 1.0)
_RAMP = np.array([BODY, rgb(ORANGE), rgb(VERMILION)])


def add_ball(server: viser.ViserServer, name: str, radius: float, colour: str) -> Any:
    """Add a ball with a radius, m, and a colour '#rrggbb'."""
    return server.scene.add_icosphere(name, radius=radius, color=as_bytes(rgb(colour)))


def as_bytes(colour: tuple[float, ...]) -> Rgb:
    """Convert red, green and blue in [0, 1] to bytes."""
    red, green, blue = (round(255.0 * value) for value in colour[:3])
    return red, green, blue


def share_colour(share: float) -> Rgb:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond."""
    return as_bytes(tuple(float(np.interp(share, _SHARES, channel)) for channel in _RAMP.T))


def share_gradient() -> str:
    """The colours of `share_colour` as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"
