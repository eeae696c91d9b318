"""What a planner carries over from one plan to the next."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.patience import Approach
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.planning.solver.solver import State
from contact_reach_ros.world.goal import Target

PLANS_KEPT = 16
"""How many of its last plans a planner keeps: one of them is in force when the next is made."""


class Memory(NamedTuple):
    """The start of the next plan."""

    plan: Plan
    goal: Target
    best: np.ndarray
    """(N,) the last plan as a point of its action space."""
    state: State
    """State of the solver at the end of its search."""
    approach: Approach
    """Progress towards the goal."""
    detour: Detour | None = None
    """The same, and the way that leads there; None if the settings permit no detours."""


class History(NamedTuple):
    """Everything that a plan depends on besides its arguments, so that it can be computed again."""

    plans: tuple[Plan, ...]
    """Plans that may be in force before it takes effect, in order."""
    memory: Memory | None
    last_state: tuple[int, Array] | None
    """Time in ns and joint angles (n,) in rad that the last plan was made for."""
    since_reset: int
    """Number of plans since the planner was reset, which selects the random numbers together with the seed."""
    number: int
    """Number of the last plan."""
