"""Plans in bags: the numbers that the next plan starts from, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.memory import Memory
from contact_reach_ros.planning.plan import HeldReference, Plan
from contact_reach_ros.planning.solver.solver import State

Floats = NDArray[np.float32]

KEYFRAME_EVERY = 10
"""The solver's state is large and recorded only for every so many plans; the plans in between follow from it."""

SPEED = "speed scale"

_PLAN_PARTS = ("plan", "positions", "rotations", "postures", "best", "approach")
_BEFORE = "before"
"""The reference from which the first knot is approached: position, rotation, posture."""
_DETOUR = "detour"


def plan_statistics(plan: Plan) -> dict[str, Any]:
    """How a plan was found, by the keys of diagnostics and plan/statistics; the same for the same request."""
    return {
        "steps": plan.steps,
        "non-finite candidates": plan.rejected,
        "spheres left out": plan.left_out,
        SPEED: plan.speed_scale,
        "cost": plan.cost,
        **{f"cost {name}": value for name, value in plan.cost_terms.items()},
    }


def solution_parts(plan: Plan, memory: Memory) -> dict[str, Floats]:
    """The parts of a message plan/solution, each an array in single precision, the planner's own.

    A keyframe also contains the solver's state, by the names of its fields.
    """
    values = (
        # In single precision, integers are exact up to 2**24.
        np.array([plan.number]),
        plan.positions,
        plan.rotations,
        plan.postures,
        memory.best,
        np.array(memory.approach),
    )
    parts = dict(zip(_PLAN_PARTS, values, strict=True))
    if plan.before is not None:
        parts[_BEFORE] = np.concatenate([np.ravel(part) for part in plan.before])
    if memory.detour is not None:
        parts[_DETOUR] = memory.detour.numbers
    if plan.number % KEYFRAME_EVERY == 1:
        parts |= memory.state._asdict()
    return {name: np.asarray(part, dtype=np.float32) for name, part in parts.items()}


def is_keyframe(parts: Mapping[str, Floats]) -> bool:
    """Whether the parts include the solver's state."""
    return any(name not in (*_PLAN_PARTS, _BEFORE, _DETOUR) for name in parts)


def before_in(parts: Mapping[str, Floats]) -> HeldReference | None:
    """The reference from which the first knot was approached; None where it stepped."""
    if _BEFORE not in parts:
        return None
    values = parts[_BEFORE].astype(float)
    return HeldReference(values[:3], values[3:12].reshape(3, 3), values[12:])


def detour_in(parts: Mapping[str, Floats]) -> Detour | None:
    """Progress on detours; None where none were permitted."""
    return Detour.of(parts[_DETOUR]) if _DETOUR in parts else None


def state_in(parts: Mapping[str, Floats], like: State) -> State:
    """The solver's state from the parts of a keyframe, with the fields, shapes and types of the state `like`.

    Raises
    ------
    KeyError
        If a field is missing: another kind of solver was recorded.
    ValueError
        If a part has another size.
    """
    fields = {name: np.asarray(value) for name, value in like._asdict().items()}
    return type(like)(**{name: parts[name].reshape(it.shape).astype(it.dtype) for name, it in fields.items()})
