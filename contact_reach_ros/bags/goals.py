"""Which of the goals in a bag the planner pursued: those that it refused are only on their topic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array

_KEYS = ("goal x m", "goal y m", "goal z m")
_CLOSE = 1e-5
"""Distance within which a goal and that of a plan, which is written with six digits, are the same, m."""


def goal_values(position: Array) -> dict[str, float]:
    """The goal of a plan, at `position` (3,), m, for plan/statistics."""
    return dict(zip(_KEYS, position.tolist(), strict=True))


def goal_in(numbers: Mapping[str, float]) -> Array | None:
    """The goal (3,), m, among the numbers of a plan; None in bags of earlier versions."""
    return np.array([numbers[key] for key in _KEYS]) if all(key in numbers for key in _KEYS) else None


def pursued(positions: Array, planned: Sequence[Array]) -> NDArray[np.bool_]:
    """(n,) whether the goals at `positions` (n, 3), m, are goals of plans; all are if no plan names its goal."""
    if not len(planned):
        return np.ones(len(positions), bool)
    away = np.abs(positions[:, None] - np.unique(np.stack(planned), axis=0)).max(axis=2)
    return np.asarray((away < _CLOSE).any(axis=1))
