"""A way to reach a goal: what makes plans, and the controller that follows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from contact_reach_ros.arm import Arm
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.planning.plan import PlanningCore


@dataclass(frozen=True)
class Method:
    """What differs between the ways that episodes compare.

    Attributes
    ----------
    planner
        Makes plans, with room for the scene's obstacles.
    settings
        Of the controller.
    controller
        Makes the controller, from the time between joint states, s, too; each episode has one of its own.
    """

    planner: PlanningCore
    settings: ControllerSettings
    controller: Callable[[Arm, ControllerSettings, float], Controller] = Controller

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Prepare whatever the first plan would have to wait for; `progress` gets a line for the user at each stage."""
        self.planner.warm_up(progress)

    def reseed(self, seed: int) -> None:
        """Draw the random numbers of the next episodes from this seed."""
        self.planner.reseed(seed)
