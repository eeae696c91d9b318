"""Pictures drawn with matplotlib, for machines without OpenGL: shaded triangles from the farthest to the nearest."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from contact_reach_ros.rendering.shapes import as_mesh, inside
from contact_reach_ros.rendering.view import LIGHT, View

Array = NDArray[np.float64]

_AMBIENT = 0.55
_SHADOW = 0.86
"""Brightness of the floor in the shadow of an arm that cannot be seen through."""


def draw(view: View) -> NDArray[np.uint8]:
    """The view as (height, width, 3)."""
    camera = view.camera
    figure = Figure(figsize=(camera.width / 100.0, camera.height / 100.0), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0, camera.width)
    axes.set_ylim(0, camera.height)
    triangles, colours = _triangles(view)
    if view.floor is not None:
        _fill(axes, *_floor(view, triangles[colours[:, 3] == 1.0]))
    corners, depths = camera.project(triangles)
    order = np.argsort(-depths.mean(axis=1))
    _fill(axes, corners[order], colours[order])
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _floor(view: View, triangles: Array) -> tuple[Array, Array]:
    """The floor's disc with the shadows of triangles (n, 3, 3) on it, as polygons of pixels, and their colours."""
    assert view.floor is not None
    floor = view.floor
    angles = np.linspace(0.0, 2.0 * np.pi, 121)
    edge = floor.end + floor.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    disc = np.stack([np.tile(floor.end, (120, 1)), edge[:-1], edge[1:]], axis=1)
    above = triangles - floor.end
    shadows = above - above[..., 2:] * (LIGHT / LIGHT[2])
    shadows = floor.end + shadows[(np.linalg.norm(shadows, axis=-1) < floor.radius).all(axis=1)]
    shade = (*(_SHADOW * np.array(floor.colour[:3])), 1.0)
    colours = np.concatenate([np.tile(floor.colour, (len(disc), 1)), np.tile(shade, (len(shadows), 1))])
    return view.camera.project(np.concatenate([disc, shadows]))[0], colours


def _triangles(view: View) -> tuple[Array, Array]:
    """Corners (n, 3, 3) and shaded colours (n, 4) of all triangles that face the camera."""
    meshes = [as_mesh(shape) for shape in view.shapes]
    if not meshes:
        return np.zeros((0, 3, 3)), np.zeros((0, 4))
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    colours = np.concatenate([np.tile(mesh.colour, (len(mesh.faces), 1)) for mesh in meshes])
    # What is hidden inside others would shine through where their triangles are as far away.
    hidden = np.zeros(len(triangles), bool)
    centers = triangles.mean(axis=1)
    for shape in view.shapes:
        if shape.colour[3] == 1.0:
            hidden |= inside(shape, centers)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    facing = np.einsum("ij,ij->i", normals, view.camera.eye - triangles[:, 0])
    shown = ~hidden & (areas > 1e-12) & (facing > 0.0)
    triangles, colours, normals = triangles[shown], colours[shown], normals[shown] / areas[shown, None]
    colours[:, :3] *= _AMBIENT + (1.0 - _AMBIENT) * np.maximum(normals @ LIGHT, 0.0)[:, None]
    return triangles, colours


def _fill(axes: Axes, corners: Array, colours: Array) -> None:
    # Edges of the same colour close the seams between triangles, but would show where one sees through.
    opaque = colours[:, 3] == 1.0
    edges = np.where(opaque[:, None], colours, 0.0)
    axes.add_collection(PolyCollection(list(corners), facecolors=colours, edgecolors=edges, linewidths=0.4))
