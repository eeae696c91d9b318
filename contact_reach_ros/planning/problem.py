"""What a planner is asked and what it answers: goal, obstacle spheres and plan (numpy only)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Goal:
    """Where the flange shall be, in the base frame.

    Raises
    ------
    InputError
        If a value is not finite, has the wrong shape, or the rotation is not a rotation matrix.
    """

    position: Array
    """(3,), m."""
    rotation: Array | None = None
    """(3, 3), or None for a goal that leaves the orientation free."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _checked("goal position", self.position, (3,)))
        if self.rotation is not None:
            rotation = _checked("goal rotation", self.rotation, (3, 3))
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
                raise InputError(
                    "goal rotation: expected an orthonormal, right-handed matrix; normalise its quaternion"
                )
            object.__setattr__(self, "rotation", rotation)

    def same_as(self, other: Goal | None) -> bool:
        """Whether both ask for the same pose, to the last bit."""
        if other is None or (self.rotation is None) != (other.rotation is None):
            return False
        same_rotation = self.rotation is None or np.array_equal(self.rotation, np.asarray(other.rotation))
        return same_rotation and np.array_equal(self.position, other.position)


@dataclass(frozen=True)
class Spheres:
    """Obstacle spheres, each held to its rest position by a spring and slowed by a damper, in the base frame.

    Raises
    ------
    InputError
        If a value is not finite, the shapes disagree, or a radius, stiffness or damping is not positive.
    """

    center: Array
    """(K, 3), where the spheres are now, m."""
    rest: Array
    """(K, 3), where their springs pull them, m."""
    radius: Array
    """(K,), m."""
    stiffness: Array
    """(K,) of the spring to the rest position, N/m."""
    damping: Array
    """(K,) of the motion through the surroundings, N s/m."""

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.radius))
        for name, shape in (("center", (count, 3)), ("rest", (count, 3))):
            object.__setattr__(self, name, _checked(f"sphere {name}", getattr(self, name), shape))
        for name in ("radius", "stiffness", "damping"):
            values = _checked(f"sphere {name}", getattr(self, name), (count,))
            if (values <= 0.0).any():
                raise InputError(f"sphere {name}: expected positive values, got {values.min():g}")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.radius)

    @classmethod
    def none(cls) -> Spheres:
        """No obstacles."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Plan:
    """References of H knots and what the planner expects of them.

    Knot i holds from effect + i dt, excluded, to effect + (i + 1) dt, included.
    """

    number: int
    """Counted from 1 by each planner."""
    effect_ns: int
    """When knot 0 takes effect, on the clock of the states, ns."""
    knot_duration_s: float
    """dt, s."""
    positions: Array
    """(H, 3) translation of x_d, flange in the base frame, m."""
    rotations: Array
    """(H, 3, 3) rotation of x_d."""
    postures: Array
    """(H, 7) q_d of law (2), rad."""
    predicted_q: Array
    """(H + 1, 7) joint angles at the knot boundaries, rad."""
    predicted_positions: Array
    """(H + 1, 3) flange at the knot boundaries, m."""
    predicted_contact_forces: Array
    """(H, 6) largest contact force within each knot on each link of `iiwa14.CAPSULES`, N."""
    cost: float
    """Value of (5)."""
    cost_terms: dict[str, float]
    """The parts that add up to `cost`."""
    steps: int
    """Solver steps taken."""
    stop_reason: str
    """"stagnated", "max_steps" or "deadline"."""
    solve_s: float
    """Wall-clock time of the whole call, s."""
    rejected: int
    """Candidates whose cost was not finite."""
    left_out: int
    """Obstacle spheres beyond the planner's capacity, which it did not look at."""

    @property
    def knot_duration_ns(self) -> int:
        """dt, ns."""
        return round(self.knot_duration_s * 1e9)


def _checked(name: str, values: object, shape: tuple[int, ...]) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite values, got {array.ravel().tolist()}")
    array.setflags(write=False)
    return array
