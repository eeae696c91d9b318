"""Plans: references of several knots, and the motion that the planner predicts under them, without JAX."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.control.references import References


class HeldReference(NamedTuple):
    """x_d and q_d that are constant in time."""

    position: Array
    """(3,), m."""
    rotation: Array
    """(3, 3)."""
    posture: Array
    """(n,), rad."""


Held = tuple[Any, ...]
"""What is in force for a while, a NamedTuple of arrays: `HeldReference`, unless a method plans something different."""


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
    before: HeldReference | None = None
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
        target = HeldReference(self.positions[knot], self.rotations[knot], self.postures[knot])
        elapsed = (time_ns - self.effect_ns - knot * self.knot_duration_ns) * 1e-9
        if elapsed >= self.ramp_s or self.before is None:
            return target
        # Where the knot before it ended.
        start: Any = self.before if knot == 0 else self.in_force(self.effect_ns + knot * self.knot_duration_ns)
        return _between(start, target, elapsed / self.ramp_s)


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
    """"stagnated", "max_steps" or "deadline"."""
    solve_s: float
    """Wall-clock time of the whole call, s."""
    rejected: int
    """Candidates whose cost was not finite."""
    left_out: int
    """Obstacle spheres beyond the planner's capacity, which were ignored."""
    speed_scale: float = 1.0
    """Share of γ that its actions are bounded by."""

    def statistics(self) -> dict[str, Any]:
        """How the plan was found, by the keys of diagnostics and plan/statistics; the same for the same request."""
        return {
            "steps": self.steps,
            "non-finite candidates": self.rejected,
            "spheres left out": self.left_out,
            "speed scale": self.speed_scale,
            "cost": self.cost,
            **{f"cost {name}": value for name, value in self.cost_terms.items()},
        }


def _between(start: HeldReference, end: HeldReference, share: float) -> HeldReference:
    """As `law.blend`, which is compiled for the controller's tick: planners need not wait for that when they start."""
    turn = Rotation.from_matrix(end.rotation @ start.rotation.T).as_rotvec()
    return HeldReference(
        position=start.position + share * (end.position - start.position),
        rotation=Rotation.from_rotvec(share * turn).as_matrix() @ start.rotation,
        posture=start.posture + share * (end.posture - start.posture),
    )
