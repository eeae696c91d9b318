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


def as_bytes(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of '#rrggbb', 0 to 255."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
