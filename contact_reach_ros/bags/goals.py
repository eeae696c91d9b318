"""The goal of a plan, among the numbers of plan/statistics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from contact_reach_ros.arm.arrays import Array

_KEYS = ("goal x m", "goal y m", "goal z m")


def goal_values(position: Array) -> dict[str, float]:
    """The goal of a plan, at `position` (3,), m, for plan/statistics."""
    return dict(zip(_KEYS, position.tolist(), strict=True))


def goal_in(numbers: Mapping[str, float]) -> Array | None:
    """The goal (3,), m, among the numbers of a plan; None in bags of earlier versions."""
    return np.array([numbers[key] for key in _KEYS]) if all(key in numbers for key in _KEYS) else None
