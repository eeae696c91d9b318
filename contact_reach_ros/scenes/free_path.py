"""The path that the arm takes without obstacles, kinematically: what random scenes are built around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel

Array = NDArray[np.float64]

MIN_MOBILITY = 0.05
"""Smallest eigenvalue of J M⁻¹ Jᵀ, 1/kg, below which a configuration counts as singular."""

_STEP = 0.004
_SETTLING = 5
_LIMIT_MARGIN = 0.2


def free_path(model: RobotModel, start: Array, target: Array) -> Array | None:
    """Joint angles (N, 7) along the straight line to a flange position, orientation held, least joint motion.

    Inverse kinematics in steps of a few millimetres with the dynamically consistent inverse, as the impedance law would
    move the arm. None if the line cannot be followed: it leaves the workspace, comes near a singularity
    (`MIN_MOBILITY`) or within 0.2 rad of a joint limit.
    """
    limits = np.array(iiwa14.POSITION_LIMITS) - _LIMIT_MARGIN
    q, v = start.copy(), np.zeros_like(start)
    model.update(q, v)
    origin, rotation = model.position.copy(), model.rotation.copy()
    count = int(np.ceil(np.linalg.norm(target - origin) / _STEP))
    path = [q.copy()]
    for share in (*np.linspace(0.0, 1.0, count + 1)[1:], *np.ones(_SETTLING)):
        error = np.empty(6)
        error[:3] = model.position - origin - share * (target - origin)
        error[3:] = 0.5 * sum(np.cross(rotation[:, k], model.rotation[:, k]) for k in range(3))
        if model.smallest_mobility() < MIN_MOBILITY:
            return None
        inverse_mass_jacobian = np.linalg.solve(model.mass_matrix, model.jacobian.T)
        q = q - inverse_mass_jacobian @ np.linalg.solve(model.jacobian @ inverse_mass_jacobian, error)
        if (np.abs(q) > limits).any():
            return None
        path.append(q.copy())
        model.update(q, v)
    return np.array(path) if np.linalg.norm(model.position - target) < 1e-3 else None
