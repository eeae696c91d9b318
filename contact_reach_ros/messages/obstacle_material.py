"""The material of an obstacle as the text of its marker."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.errors import InputError


class BodyMaterial(NamedTuple):
    """What a marker's text may say of a body."""

    stiffness: float
    """Spring that holds each sphere that can move to its place, N/m."""
    damping: float
    """N s/m."""
    edge_stiffness: float
    """N/m; of no meaning for a ball."""


_MATERIAL = "material:"


def material_text(material: BodyMaterial) -> str:
    """The material as the text of a marker has it: 'material: stiffness=100.0 damping=30.0 edge_stiffness=0.0'."""
    return " ".join([_MATERIAL, *(f"{name}={value!r}" for name, value in material._asdict().items())])


def material_of(marker: Any, name: str) -> BodyMaterial | None:
    """The material in a marker's text; None where the text is about something else."""
    if not marker.text.startswith(_MATERIAL):
        return None
    try:
        values = dict(word.split("=") for word in marker.text.removeprefix(_MATERIAL).split())
        material = BodyMaterial(**{key: float(value) for key, value in values.items()})
        if not (min(material) >= 0.0 and material.damping > 0.0 and np.isfinite(material).all()):
            raise ValueError
    except (ValueError, TypeError) as error:
        raise InputError(
            f"obstacles: marker {name}: text = '{marker.text}'; expected one like "
            f"'{material_text(BodyMaterial(100.0, 30.0, 0.0))}', no value negative and a positive damping"
        ) from error
    return material
