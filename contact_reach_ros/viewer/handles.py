"""Helpers for viser's handles and colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from contact_reach_ros.drawing.palette import ORANGE, VERMILION, rgb
from contact_reach_ros.drawing.parts import BODY

Rgb = tuple[int, int, int]

_STEPS = 24
"""Number of steps in the colours of shares, since each change is sent to the browsers."""
_SHARES = (0.0, 0.5, 1.0)
_RAMP = np.array([BODY, rgb(ORANGE), rgb(VERMILION)])


def set_if_changed(handle: Any, name: str, value: Any) -> None:
    """Set a property unless it has this value already: each assignment is sent to all browsers."""
    present = getattr(handle, name)
    same = np.array_equal(present, value) if isinstance(present, np.ndarray) else present == value
    if not same:
        setattr(handle, name, value)


def add_ball(server: viser.ViserServer, name: str, radius: float, colour: str) -> Any:
    """Add a ball with a radius, m, and a colour '#rrggbb'."""
    return server.scene.add_icosphere(name, radius=radius, color=as_bytes(rgb(colour)))


def as_bytes(colour: tuple[float, ...]) -> Rgb:
    """Convert red, green and blue in [0, 1] to bytes."""
    red, green, blue = (round(255.0 * value) for value in colour[:3])
    return red, green, blue


def share_colour(share: float) -> Rgb:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond."""
    stepped = round(min(max(share, 0.0), 1.0) * _STEPS) / _STEPS
    return as_bytes(tuple(float(np.interp(stepped, _SHARES, _RAMP[:, channel])) for channel in range(3)))


def share_gradient() -> str:
    """The colours of `share_colour` as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"
