"""What a planner carries over from one plan to the next."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from contact_reach_ros.planning.detour import Detour
from contact_reach_ros.planning.patience import Approach
from contact_reach_ros.planning.plan import ReferenceTrajectory
from contact_reach_ros.planning.planning_core import Request
from contact_reach_ros.planning.solver.solver import State


class Memory(NamedTuple):
    """Everything that the next plan depends on besides its request and the seed."""

    trajectories: tuple[ReferenceTrajectory, ...]
    """The last plans, in order; one of them is in force when the next plan is made."""
    request: Request
    """What the last plan was made for."""
    best: np.ndarray
    """(N,) the last plan as a point of the solver's box."""
    state: State | None
    """State of the solver at the end of its search; None to search anew around `best`."""
    approach: Approach
    """Progress towards the goal."""
    detour: Detour | None
    """The same, and the way that leads there; None if the settings permit no detours."""
    plans: int
    """Number of plans since the planner was reset, which selects the random numbers together with the seed."""
