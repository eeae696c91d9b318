"""Requests for plans, plans, and the interface of a core that makes one from the other, without JAX.

A plan has references of several knots, and the motion that the planner predicts under them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

from contact_reach_ros.arm import Array
from contact_reach_ros.control.references import Reference, References, Way
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres

if TYPE_CHECKING:
    from contact_reach_ros.planning.detour import Detour


Held = tuple[Any, ...]
"""What is in force for a while, a NamedTuple of arrays: `Reference`, unless a method plans something different."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferenceTrajectory:
    """References of H knots. Knot i holds from effect + i dt, excluded, to effect + (i + 1) dt, included."""

    effect_ns: int
    """When knot 0 takes effect, on the clock of the states, ns."""
    knot_duration_s: float
    """dt, s."""
    positions: Array
    """(H, 3) translation of x_d, flange in the base frame, m."""
    rotations: Array
    """(H, 3, 3) rotation of x_d."""
    postures: Array
    """(H, n) q_d of law (2), rad."""
    before: Reference | None = None
    """What is in force at the effect, from which the reference moves to knot 0; None if it steps."""
    ramp_s: float = 0.0
    """Time in which the reference moves to a knot, from its beginning on, s."""

    @property
    def knot_duration_ns(self) -> int:
        """dt, ns."""
        return round(self.knot_duration_s * 1e9)

    def references(self) -> References:
        """References for the controller."""
        ends_ns = tuple((knot + 1) * self.knot_duration_ns for knot in range(len(self.positions)))
        return References(self.effect_ns, ends_ns, self.positions, self.rotations, self.postures)

    def without_knots(self) -> Self:
        """The same trajectory with nothing in force after its effect."""
        none = {name: getattr(self, name)[:0] for name in ("positions", "rotations", "postures")}
        return dataclasses.replace(self, **none)

    @property
    def changes_ns(self) -> list[int]:
        """Times at which what is in force begins, or ends, to change, ns, from the effect to the expiry."""
        begins = [self.effect_ns + knot * self.knot_duration_ns for knot in range(len(self.positions) + 1)]
        ramp_ns = round(1e9 * self.ramp_s)
        ends = [begin + ramp_ns for begin in begins[:-1]] if 0 < ramp_ns < self.knot_duration_ns else []
        return sorted([*begins, *ends])

    def in_force(self, time_ns: int) -> Held | None:
        """What is in force at a time after the effect, ns; None once the plan has run out."""
        knot = (time_ns - self.effect_ns - 1) // self.knot_duration_ns
        if knot >= len(self.positions):
            return None
        target = Reference(self.positions[knot], self.rotations[knot], self.postures[knot])
        elapsed = (time_ns - self.effect_ns - knot * self.knot_duration_ns) * 1e-9
        if elapsed >= self.ramp_s or self.before is None:
            return target
        # Where the knot before it ended.
        start: Any = self.before if knot == 0 else self.in_force(self.effect_ns + knot * self.knot_duration_ns)
        return Way(start, target).at(elapsed / self.ramp_s)


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan(ReferenceTrajectory):
    """References of H knots and the motion predicted under them."""

    number: int
    """Counted from 1 by each planner."""
    predicted_q: Array
    """(H + 1, n) joint angles at the knot boundaries, rad."""
    predicted_positions: Array
    """(H + 1, 3) flange at the knot boundaries, m."""
    predicted_contact_forces: Array
    """(H, L) largest contact force within each knot on each of the arm's `contact_links`, N."""
    cost: float
    """Value of (5)."""
    cost_terms: dict[str, float]
    """The terms that add up to `cost`."""
    steps: int
    """Solver steps taken."""
    stop_reason: str
    """"stagnated", "max_steps", "deadline", or "held" for what was in force before."""
    solve_s: float
    """Wall-clock time of the whole call, s."""
    speed_scale: float = 1.0
    """Share of γ that its actions are bounded by."""

    def statistics(self) -> dict[str, Any]:
        """How the plan was found, by the keys of diagnostics and plan/statistics; the same for the same request."""
        return {
            "steps": self.steps,
            "speed scale": self.speed_scale,
            "cost": self.cost,
            **{f"cost {name}": value for name, value in self.cost_terms.items()},
        }


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
    """Target of the flange, where it is at `effect_ns` if it moves."""
    spheres: Spheres
    """Obstacles at `state_ns`."""
    speed_scale: float = 1.0
    """Share of γ that the plan may use, 0 to 1, and so of the speed."""
    detour: Detour | None = None
    """Progress towards the goal and the detour that leads there, see `Detours.target`."""
    holds: bool = False
    """Whether to hold what is in force, see `GoalProgress.holds`."""
    rest: Array | None = None
    """(3, 3) orientation to hold where the goal leaves it free, see `GoalProgress.rest`."""

    @property
    def rotation(self) -> Array | None:
        """(3, 3) orientation to plan for; None for any."""
        return self.rest if self.goal.rotation is None else self.goal.rotation

    @property
    def on_detour(self) -> int:
        """Number of the detour that the plan follows; 0 for none."""
        return self.detour.number if self.detour is not None and self.detour.is_on else 0


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
