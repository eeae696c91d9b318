"""Rendering of views of the arm with MuJoCo, by whichever OpenGL this machine has."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from contact_reach_ros.drawing.camera import frame
from contact_reach_ros.drawing.offscreen import BACKENDS, Picture, render_offscreen
from contact_reach_ros.drawing.shapes import Sphere
from contact_reach_ros.drawing.view import View
from contact_reach_ros.errors import RenderingError

AUTO = "auto"
RENDERERS = (AUTO, *BACKENDS)
"""`AUTO` stands for the first of the others that works."""

_BALL = Sphere(np.zeros(3), 0.1, (1.0, 1.0, 1.0, 1.0))
_TRIAL = View([_BALL], frame([_BALL], 16, 16))


def find_renderer(renderer: str = AUTO) -> str:
    """Name of a renderer that has just rendered a small picture: the given one or, for `AUTO`, the first that works.

    Raises
    ------
    RenderingError
        If there is no such renderer, or none works on this machine; the message says why, and what to install.
    """
    if renderer not in RENDERERS:
        raise RenderingError(f"renderer '{renderer}' is unknown; expected one of {', '.join(RENDERERS)}")
    refusals = []
    for backend in BACKENDS if renderer == AUTO else (renderer,):
        try:
            render_offscreen([_TRIAL], backend)
        except RenderingError as error:
            refusals.append(str(error))
        else:
            return backend
    raise RenderingError("; ".join(refusals))


def render(views: Sequence[View], renderer: str) -> list[Picture]:
    """Render a picture of each view with a renderer from `find_renderer`.

    Raises
    ------
    RenderingError
        If the renderer fails.
    """
    layers = iter(render_offscreen([layer for view in views for layer in _layers(view)], renderer))
    return [_overlay(next(layers), [(next(layers), ghost.opacity) for ghost in view.ghosts]) for view in views]


def _layers(view: View) -> list[View]:
    """The view without ghosts, then once with each of them drawn as solid."""
    return [
        dataclasses.replace(view, shapes=[*view.shapes, *shapes], ghosts=())
        for shapes in [(), *(ghost.shapes for ghost in view.ghosts)]
    ]


def _overlay(picture: Picture, ghosts: Sequence[tuple[Picture, float]]) -> Picture:
    mixed = picture.astype(float)
    for with_ghost, opacity in ghosts:
        mixed += opacity * (with_ghost.astype(float) - picture)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
