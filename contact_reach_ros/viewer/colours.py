"""Colours for numbers and states."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.drawing.palette import GREEN, GREY, ORANGE, VERMILION, rgb
from contact_reach_ros.drawing.parts import BODY
from contact_reach_ros.viewer.frame import SafetyLevel

Rgb = tuple[int, int, int]

BANNER = {
    SafetyLevel.OK: (GREEN, "#FFFFFF"),
    SafetyLevel.CONTACT: (ORANGE, "#000000"),
    SafetyLevel.STOP: (VERMILION, "#FFFFFF"),
}
"""Background and text colours of the banner by level."""
SILENT = (GREY, "#FFFFFF")

_STEPS = 24
_SHARES = (0.0, 0.5, 1.0)
_RAMP = np.array([BODY, rgb(ORANGE), rgb(VERMILION)])


def as_bytes(colour: tuple[float, ...]) -> Rgb:
    """Convert red, green and blue in [0, 1] to bytes."""
    red, green, blue = (round(255.0 * value) for value in colour[:3])
    return red, green, blue


def share_colour(share: float) -> Rgb:
    """Colour from the arm's own at 0 to vermilion at 1 and beyond, in steps, because each change must be sent."""
    stepped = round(min(max(share, 0.0), 1.0) * _STEPS) / _STEPS
    return as_bytes(tuple(float(np.interp(stepped, _SHARES, _RAMP[:, channel])) for channel in range(3)))


def share_gradient() -> str:
    """The same colours as a CSS gradient from left to right."""
    stops = ", ".join(f"rgb{share_colour(share)} {share:.0%}" for share in _SHARES)
    return f"linear-gradient(to right, {stops})"
