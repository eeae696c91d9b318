"""Collision geometries of a URDF as sets of balls, see `capsule_fit`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.collada import collada_points
from contact_reach_ros.arm.urdf_tree import Shape
from contact_reach_ros.errors import SettingsError

_RIM = 24
"""Points on the rim of a cylinder; their polygon is around the circle."""
_SCHEME = "package://"
_PREFIX_PATHS = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")


def shape_balls(shape: Shape, urdf: Path, packages: Mapping[str, str], where: str) -> Array:
    """Centres and radii (N, 4), in the link's frame, m, of balls whose convex hull covers a shape.

    Raises
    ------
    SettingsError
        If a mesh cannot be read; the message names the link, which `where` begins with, and the key that mends it.
    """
    radii = 0.0
    if shape.kind == "mesh":
        points = _mesh_vertices(shape, urdf, packages, where)
    elif shape.kind == "box":
        points = 0.5 * np.array(shape.size) * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    elif shape.kind == "sphere":
        points, radii = np.zeros((1, 3)), shape.size[0]
    else:
        radius, length = shape.size
        ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
        if shape.kind == "capsule":
            points, radii = ends, radius
        else:
            angles = np.linspace(0.0, 2.0 * np.pi, _RIM, endpoint=False)
            rim = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1) * radius / np.cos(np.pi / _RIM)
            points = np.concatenate([rim + end for end in ends])
    placed = points @ shape.place[:3, :3].T + shape.place[:3, 3]
    return np.column_stack([placed, np.full(len(placed), radii)])


def _mesh_vertices(shape: Shape, urdf: Path, packages: Mapping[str, str], where: str) -> Array:
    path = _mesh_file(shape.file, urdf, packages)
    mend = "give the folder of its package under packages, or the link's capsules under capsules ([] for none)"
    if path is None:
        raise SettingsError(f"{where}: mesh '{shape.file}' is not found; {mend}")
    try:
        is_collada = path.suffix.lower() == ".dae"
        vertices = collada_points(path) if is_collada else np.asarray(trimesh.load_mesh(path).vertices)
    except Exception as error:  # trimesh's readers raise whatever their formats lead to
        raise SettingsError(f"{where}: mesh '{path}' cannot be read ({error}); {mend}") from error
    if len(vertices) < 4 or not np.isfinite(vertices).all():
        raise SettingsError(f"{where}: mesh '{path}' holds {len(vertices)} usable vertices; {mend}")
    try:
        outer = vertices[ConvexHull(vertices).vertices]
    except QhullError:
        # A flat one: all of it is outside.
        outer = vertices
    return np.unique(outer, axis=0) * np.array(shape.size)


def _mesh_file(name: str, urdf: Path, packages: Mapping[str, str]) -> Path | None:
    """The file that a URDF names: beside it, or in a package that is given, above it, or installed."""
    if not name.startswith(_SCHEME):
        path = urdf.parent / name.removeprefix("file://")
        return path if path.is_file() else None
    package, _, rest = name.removeprefix(_SCHEME).partition("/")
    installed = [Path(prefix) for key in _PREFIX_PATHS for prefix in os.environ.get(key, "").split(":") if prefix]
    folders = [
        *([urdf.parent / packages[package]] if package in packages else []),
        *(parent / package for parent in urdf.resolve().parents),
        *(parent for parent in urdf.resolve().parents if parent.name == package),
        *(prefix / "share" / package for prefix in installed),
        *(prefix / package for prefix in installed),
    ]
    return next((folder / rest for folder in folders if (folder / rest).is_file()), None)
