"""Helpers for viser's handles."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from contact_reach_ros.viewer.colours import as_bytes


def set_if_changed(handle: Any, name: str, value: Any) -> None:
    """Set a property unless it has this value already: each assignment is sent to all browsers."""
    present = getattr(handle, name)
    same = np.array_equal(present, value) if isinstance(present, np.ndarray) else present == value
    if not same:
        setattr(handle, name, value)


def add_ball(server: viser.ViserServer, name: str, radius: float, colour: tuple[float, float, float]) -> Any:
    """Add a ball of a radius, m, and a colour in [0, 1]."""
    return server.scene.add_icosphere(name, radius=radius, color=as_bytes(colour))
