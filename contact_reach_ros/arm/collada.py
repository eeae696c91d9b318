"""The points of a COLLADA file (.dae), for which trimesh needs a library and leaves its unit aside."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arrays import Array

_ANY = "{*}"


def collada_points(path: Path) -> Array:
    """All points (N, 3), m, where the scene's nodes place them. As in ROS, the file's up axis does not count.

    Raises
    ------
    OSError, ElementTree.ParseError, ValueError, LookupError
        If the file cannot be read or is none.
    """
    root = ElementTree.parse(path).getroot()
    by_id = {element.get("id"): element for element in root.iter() if element.get("id")}
    unit = root.find(f"{_ANY}asset/{_ANY}unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1.0))
    nodes = root.findall(f"{_ANY}library_visual_scenes/{_ANY}visual_scene/{_ANY}node")
    found = [points for node in nodes for points in _node_points(node, np.eye(4), by_id)]
    return scale * np.concatenate([np.zeros((0, 3)), *found])


def _node_points(node: Element, place: Array, by_id: dict[str | None, Element]) -> Iterator[Array]:
    """The points (N, 3) of each geometry below a node whose parent is at `place` (4, 4)."""
    for element in node:
        tag, target = element.tag.rpartition("}")[2], by_id.get(element.get("url", "").removeprefix("#"))
        if tag in _TRANSFORMS:
            place = place @ _TRANSFORMS[tag](_numbers(element))
        elif tag == "node":
            yield from _node_points(element, place, by_id)
        elif tag == "instance_node" and target is not None:
            yield from _node_points(target, place, by_id)
        elif tag == "instance_geometry" and target is not None:
            points = _geometry_points(target, by_id)
            yield points @ place[:3, :3].T + place[:3, 3]


def _geometry_points(geometry: Element, by_id: dict[str | None, Element]) -> Array:
    position = geometry.find(f".//{_ANY}vertices/{_ANY}input[@semantic='POSITION']")
    if position is None:
        return np.zeros((0, 3))
    source = by_id[position.get("source", "").removeprefix("#")]
    values = source.find(f"{_ANY}float_array")
    return np.zeros((0, 3)) if values is None else _numbers(values).reshape(-1, 3)


def _numbers(element: Element) -> Array:
    return np.array((element.text or "").split(), float)


def _translation(values: Array) -> Array:
    place = np.eye(4)
    place[:3, 3] = values
    return place


def _rotation(values: Array) -> Array:
    place = np.eye(4)
    place[:3, :3] = Rotation.from_rotvec(values[3] * values[:3], degrees=True).as_matrix()
    return place


_TRANSFORMS: dict[str, Callable[[Array], Array]] = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}
