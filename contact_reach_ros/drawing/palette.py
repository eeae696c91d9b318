"""The colours of all plots and pictures: Okabe and Ito's palette, distinct for any colour vision."""

from __future__ import annotations

BLACK = "#000000"
ORANGE = "#E69F00"
SKY_BLUE = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#555555"
"""Not part of the palette: for lines that only help to read a plot."""
MIDDLE_GREY = "#888888"
"""Not part of the palette: instead of black, where the background may be dark."""

JOINT_COLOURS = (MIDDLE_GREY, ORANGE, SKY_BLUE, GREEN, PURPLE, BLUE, VERMILION)
"""Of joints from the first to the last, and of other series, in turns; all can be seen on white and on black."""


def rgb(colour: str) -> tuple[float, float, float]:
    """Parse '#rrggbb' into red, green and blue in [0, 1]."""
    red, green, blue = (int(colour[index : index + 2], 16) / 255.0 for index in (1, 3, 5))
    return red, green, blue


def as_bytes(colour: tuple[float, ...]) -> tuple[int, int, int]:
    """Convert red, green and blue in [0, 1] to bytes."""
    red, green, blue = (round(255.0 * value) for value in colour[:3])
    return red, green, blue
