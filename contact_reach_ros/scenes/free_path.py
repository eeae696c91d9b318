"""The path that the arm takes without obstacles, by kinematics alone; random scenes are built around it."""

from __future__ import annotations

import numpy as np

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.model import RobotModel

MIN_MOBILITY = 0.05
"""Smallest eigenvalue of J M⁻¹ Jᵀ, 1/kg, below which a configuration counts as singular."""

_STEP = 0.004
_SETTLING = 5
_LIMIT_MARGIN = 0.2


def free_path(model: RobotModel, start: Array, target: Array) -> Array | None:
    """Joint angles (N, n) along the straight line to a flange position, orientation held, least joint motion.

    Inverse kinematics in steps of a few millimetres with the dynamically consistent inverse, as the impedance law would
    move the arm. None if the line leaves the workspace, or comes near a singularity (`MIN_MOBILITY`) or within 0.2 rad
    of a joint limit.
    """
    lower, upper = model.arm.lower + _LIMIT_MARGIN, model.arm.upper - _LIMIT_MARGIN
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
        if ((q < lower) | (q > upper)).any():
            return None
        path.append(q.copy())
        model.update(q, v)
    return np.array(path) if np.linalg.norm(model.position - target) < 1e-3 else None
