"""What an episode asks of any way to reach a goal, and the one that plans references for laws (1)-(3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference import PoseKnots, PostureKnots
from contact_reach_ros.planning.problem import Goal, Plan, Spheres
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


class Planner(Protocol):
    """Makes plans, each for a state that was measured a while before it takes effect."""

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Prepare whatever the first plan would have to wait for."""

    def reset(self) -> None:
        """Forget the plans made so far."""

    def reseed(self, seed: int) -> None:
        """Draw other random numbers from now on."""

    def plan(self, q: Array, v: Array, state_ns: int, effect_ns: int, goal: Goal, spheres: Spheres) -> Plan:
        """As `RecedingHorizonPlanner.plan`; `PlanningError` if there is no way to the goal."""


class Method(Protocol):
    """A way to reach a goal: plans now and then, and torques at each tick."""

    @property
    def stop_reason(self) -> str:
        """Why the arm was stopped; empty if it was not."""

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Prepare whatever the first plan would have to wait for; `progress` is called with a line for the user."""

    def reseed(self, seed: int) -> None:
        """Draw the random numbers of the next episodes from this seed; what was prepared stays."""

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        """Begin an episode with the arm at rest at `q` (7,), rad; hold it until there is a plan."""

    def plan(self, q: Array, v: Array, now_ns: int, effect_ns: int, goal: Goal, spheres: Spheres) -> Plan:
        """Plan from the state measured now and follow that plan from `effect_ns` on.

        Raises
        ------
        PlanningError
            If there is no way to the goal.
        """

    def torque(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        """Joint torques (7,) for a state stamped `now_ns`, N m; `clock_ns` is the clock of `observer_report`.

        None when nothing may be commanded any more.
        """

    def observer_report(self, stopped_because: str, clock_ns: int, distrust: str = "") -> None:
        """Hear that the observer lives; a non-empty reason stops the arm, and `distrust` ends all commands."""


class ControlledMethod:
    """What methods have in common: a planner, and a controller that holds and stops the arm.

    Parameters
    ----------
    planner
        With room for the scene's obstacles.
    settings
        Of the controller.
    """

    def __init__(self, planner: Planner, settings: ControllerSettings) -> None:
        self.planner = planner
        self._settings = settings
        self._controller = Controller(settings, RobotModel())

    @property
    def stop_reason(self) -> str:
        """Why the controller stopped the arm; empty if it did not."""
        return self._controller.stop_reason

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Warm the planner up."""
        self.planner.warm_up(progress)

    def reseed(self, seed: int) -> None:
        """Reseed the planner."""
        self.planner.reseed(seed)

    def start(self, q: Array, v: Array, now_ns: int) -> None:
        """Begin with a new controller, and without earlier plans."""
        self.planner.reset()
        self._controller = Controller(self._settings, self._controller.model)
        self._controller.start(q, v, now_ns)

    def observer_report(self, stopped_because: str, clock_ns: int, distrust: str = "") -> None:
        """Pass the report on to the controller."""
        self._controller.observer_report(stopped_because, clock_ns, distrust)


class ReferenceMethod(ControlledMethod):
    """A planner whose references the controller follows by laws (1)-(3), or (6)."""

    def plan(self, q: Array, v: Array, now_ns: int, effect_ns: int, goal: Goal, spheres: Spheres) -> Plan:
        """Let the planner plan and hand its references to the controller."""
        plan = self.planner.plan(q, v, now_ns, effect_ns, goal, spheres)
        self.follow(plan, now_ns)
        return plan

    def follow(self, plan: Plan, now_ns: int) -> None:
        """Hand the references of a plan to the controller.

        Raises
        ------
        InputError
            If the controller refuses them, because they are no longer valid, say.
        """
        knot_ns = round(plan.knot_duration_s * NANOSECONDS)
        ends = tuple((index + 1) * knot_ns for index in range(len(plan.positions)))
        references = self._controller.references
        references.offer_poses(PoseKnots(plan.effect_ns, ends, plan.positions, plan.rotations), now_ns)
        references.offer_postures(PostureKnots(plan.effect_ns, ends, plan.postures), now_ns)

    def torque(self, q: Array, v: Array, now_ns: int, clock_ns: int) -> Array | None:
        """One tick of the controller."""
        return self._controller.tick(q, v, now_ns, clock_ns)
