"""Makes pictures with whatever this machine has."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import RenderingError
from contact_reach_ros.rendering.drawing import draw
from contact_reach_ros.rendering.offscreen import BACKENDS, render_offscreen
from contact_reach_ros.rendering.view import View

Picture = NDArray[np.uint8]

AUTO = "auto"
MATPLOTLIB = "matplotlib"
RENDERERS = (AUTO, *BACKENDS, MATPLOTLIB)
"""`AUTO` is the first of the others that works."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """Pictures, each (height, width, 3), and the name of the renderer that made them."""

    pictures: list[Picture]
    renderer: str


def render(views: Sequence[View], renderer: str = AUTO) -> Rendering:
    """Make a picture of each view.

    Raises
    ------
    RenderingError
        If the renderer is unknown, or cannot be used on this machine.
    """
    if renderer not in RENDERERS:
        raise RenderingError(f"renderer '{renderer}' is unknown; expected one of {', '.join(RENDERERS)}")
    layers = [layer for view in views for layer in _layers(view)]
    pictures, name = _render_layers(layers, renderer)
    remaining = iter(pictures)
    mixed = []
    for view in views:
        solid = next(remaining)
        mixed.append(_overlay(solid, [(next(remaining), ghost.opacity) for ghost in view.ghosts]))
    return Rendering(mixed, name)


def _render_layers(layers: Sequence[View], renderer: str) -> tuple[list[Picture], str]:
    if renderer == AUTO:
        for backend in BACKENDS:
            with contextlib.suppress(RenderingError):
                return render_offscreen(layers, backend), backend
    if renderer in BACKENDS:
        return render_offscreen(layers, renderer), renderer
    return [draw(layer) for layer in layers], MATPLOTLIB


def _layers(view: View) -> list[View]:
    """The view without ghosts, then once with each of them as if it were solid."""
    return [
        dataclasses.replace(view, shapes=[*view.shapes, *shapes], ghosts=())
        for shapes in [(), *(ghost.shapes for ghost in view.ghosts)]
    ]


def _overlay(picture: Picture, ghosts: Sequence[tuple[Picture, float]]) -> Picture:
    mixed = picture.astype(float)
    for with_ghost, opacity in ghosts:
        mixed += opacity * (with_ghost.astype(float) - picture)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
