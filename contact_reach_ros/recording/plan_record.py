"""How a plan is kept in a bag: the numbers that the next plan starts from, to the last bit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.problem import Plan
from contact_reach_ros.planning.receding_horizon import Memory
from contact_reach_ros.planning.solver.cma_es import Distribution

Floats = NDArray[np.float32]

KEYFRAME_EVERY = 10
"""Plans: of these only the distribution is kept, which is large; those between follow from them."""

_DISTRIBUTION = Distribution._fields


def solution_parts(plan: Plan, memory: Memory) -> dict[str, Floats]:
    """The parts of a message plan/solution, each an array in single precision, in which the planner computes."""
    parts = {
        # In single precision whole numbers are exact up to 2**24.
        "plan": np.array([plan.number]),
        "positions": plan.positions,
        "rotations": plan.rotations,
        "postures": plan.postures,
        "best": memory.best,
        "approach": np.array(memory.approach),
    }
    if plan.number % KEYFRAME_EVERY == 1:
        parts |= {name: np.asarray(getattr(memory.distribution, name)) for name in _DISTRIBUTION}
    return {name: np.asarray(part, dtype=np.float32) for name, part in parts.items()}


def distribution_of(parts: Mapping[str, Floats]) -> Distribution | None:
    """The distribution in the parts of a keyframe; None in those of another plan."""
    if _DISTRIBUTION[0] not in parts:
        return None
    count = parts["mean"].size
    shaped = {name: parts[name] for name in _DISTRIBUTION}
    shaped["covariance"] = shaped["covariance"].reshape(count, count)
    shaped["sigma"] = shaped["sigma"].reshape(())
    generation = shaped["generation"].reshape(()).astype(np.int32)
    return Distribution(**{**shaped, "generation": generation})  # type: ignore[arg-type]
