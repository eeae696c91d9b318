"""Receding-horizon planning: a sequence of plans, each starting from what is left of the one before."""

from __future__ import annotations

from collections.abc import Callable

from numpy.typing import ArrayLike

from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.planning.settings import PlanningSettings


class RecedingHorizonPlanner:
    """Plans references for laws (1)-(3) again and again; to be called from one thread.

    Parameters
    ----------
    settings
        The problem and its solver.
    gains
        Gains of the controller, which the transfer model runs inside.
    permitted_force
        ε of (4d), N, from the contact budget.
    capacity
        Number of obstacle spheres that the compiled program looks at; 0 compiles one without contact.
    """

    def __init__(
        self,
        settings: PlanningSettings,
        gains: ImpedanceSettings,
        permitted_force: float,
        capacity: int,
    ) -> None:
        raise NotImplementedError

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Compile every program that `plan` needs; `progress` is called with a line for the user at each stage."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget the plans made so far: the goal was withdrawn, or the arm moved in a way no plan asked for."""
        raise NotImplementedError

    def plan(
        self,
        q: ArrayLike,
        v: ArrayLike,
        state_ns: int,
        effect_ns: int,
        goal: Goal,
        spheres: Spheres,
    ) -> Plan:
        """Make the plan that takes effect at `effect_ns`.

        Parameters
        ----------
        q, v
            (7,) measured joint angles and velocities, rad and rad/s.
        state_ns
            When they were measured, ns.
        effect_ns
            When knot 0 shall take effect, ns; not before `state_ns`.
        goal
            Where the flange shall be.
        spheres
            Obstacles at `state_ns`.

        Raises
        ------
        InputError
            If the state is not finite or of the wrong size, or the times are out of order.
        """
        raise NotImplementedError
