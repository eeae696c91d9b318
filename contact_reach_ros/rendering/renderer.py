"""Makes pictures with whatever this machine has."""

from __future__ import annotations

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
    """Pictures, and what made them.

    Attributes
    ----------
    pictures
        Each (height, width, 3).
    renderer
        Name of the renderer.
    refusals
        Of each renderer that `AUTO` tried before, why it cannot be used on this machine.
    """

    pictures: list[Picture]
    renderer: str
    refusals: tuple[str, ...] = ()


def check_renderer(renderer: str) -> None:
    """Raise `RenderingError` if there is no such renderer; the message lists those there are."""
    if renderer not in RENDERERS:
        raise RenderingError(f"renderer '{renderer}' is unknown; expected one of {', '.join(RENDERERS)}")


def render(views: Sequence[View], renderer: str = AUTO) -> Rendering:
    """Make a picture of each view.

    Raises
    ------
    RenderingError
        If the renderer is unknown, or cannot be used on this machine.
    """
    check_renderer(renderer)
    layers = [layer for view in views for layer in _layers(view)]
    rendering = _render_layers(layers, renderer)
    remaining = iter(rendering.pictures)
    mixed = []
    for view in views:
        solid = next(remaining)
        mixed.append(_overlay(solid, [(next(remaining), ghost.opacity) for ghost in view.ghosts]))
    return dataclasses.replace(rendering, pictures=mixed)


def _render_layers(layers: Sequence[View], renderer: str) -> Rendering:
    refusals: list[str] = []
    for backend in BACKENDS if renderer == AUTO else ():
        try:
            return Rendering(render_offscreen(layers, backend), backend, tuple(refusals))
        except RenderingError as error:
            refusals.append(str(error))
    if renderer in BACKENDS:
        return Rendering(render_offscreen(layers, renderer), renderer)
    return Rendering([draw(layer) for layer in layers], MATPLOTLIB, tuple(refusals))


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
