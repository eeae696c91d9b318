"""The colours of all plots and pictures: Okabe and Ito's palette, told apart with any colour vision."""

from __future__ import annotations

BLACK = "#000000"
WHITE = "#FFFFFF"
"""The ground of every plot."""
ORANGE = "#E69F00"
SKY_BLUE = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#555555"
"""Not of the palette: lines that only help to read a plot."""

METHOD_COLOURS = {
    "contact_reach": BLUE,
    "reference_posture": VERMILION,
    "collision_free": PURPLE,
    "rrt_star": GREEN,
    "joint_torque": ORANGE,
    "cma_es": SKY_BLUE,
    "gradient": BLACK,
}
"""By the names of `baselines.methods.METHODS`."""


def rgb(colour: str) -> tuple[float, float, float]:
    """Red, green and blue in [0, 1] of '#rrggbb'."""
    red, green, blue = (int(colour[index : index + 2], 16) / 255.0 for index in (1, 3, 5))
    return red, green, blue
