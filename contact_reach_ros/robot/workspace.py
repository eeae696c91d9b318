"""Where the flange can be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot import iiwa14


def unreachable(position: NDArray[np.float64]) -> str:
    """Why the flange cannot be at `position` (3,), m, base frame; empty if nothing is known to be in the way.

    It is, if it is farther from the shoulder than the arm reaches, or inside the base. The answer goes on after the
    name of the position.
    """
    distance = float(np.linalg.norm(position - iiwa14.SHOULDER_POSITION))
    if distance > iiwa14.MAX_REACH:
        return (
            f"is {distance:.3f} m from the shoulder at {list(iiwa14.SHOULDER_POSITION)} m; the arm reaches "
            f"{iiwa14.MAX_REACH} m"
        )
    base = iiwa14.BASE_CAPSULE
    axis_point = np.array([0.0, 0.0, np.clip(position[2], 0.0, base.end[2])])
    if np.linalg.norm(position - axis_point) < base.radius:
        place = np.round(position, 3).tolist()
        return f"= {place} m lies inside the base; expected at least {base.radius} m from its axis"
    return ""
