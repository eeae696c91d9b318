"""The interface of a core that makes plans, and its requests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.planning.plan import Plan
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres


class Request(NamedTuple):
    """Everything that a plan depends on, besides the previous plans."""

    q: Array
    """Measured joint positions (n,), rad."""
    v: Array
    """Measured joint velocities (n,), rad/s."""
    state_ns: int
    """Time of the measurement, ns."""
    effect_ns: int
    """Time at which the plan takes effect, ns; not before `state_ns`."""
    goal: Target
    """Target of the flange."""
    spheres: Spheres
    """Obstacles at `state_ns`."""
    speed_scale: float = 1.0
    """Share of γ that the plan may use, 0 to 1, and so of the speed."""
    detours: bool = True
    """Whether the plan may lead through another posture, if the settings permit it."""


class PlanningCore(Protocol):
    """Computes plans, each for a state that was measured some time before the plan takes effect.

    Attributes
    ----------
    memory
        What the next plan depends on besides its request. Setting it to an earlier value makes the core plan from
        there; a core that remembers nothing has None.
    """

    memory: Any

    def warm_up(self, progress: Callable[[str], None]) -> None:
        """Prepare what the first plan would otherwise wait for; `progress` gets a line for the user at each stage."""

    def reset(self) -> None:
        """Forget the plans made so far."""

    def reseed(self, seed: int) -> None:
        """Forget the plans made so far and draw other random numbers from now on."""

    def plan(self, request: Request) -> Plan:
        """Make a plan; its `speed_scale` is the one that it was made for.

        Raises
        ------
        InputError
            If no motion from this state has a finite cost.
        PlanningError
            If there is no way to the goal, or only one through a rigid body.
        """
