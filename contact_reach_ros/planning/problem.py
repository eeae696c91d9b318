"""What a planner is asked and what it answers: goal, obstacle spheres and plan (numpy only)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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
    """Obstacle spheres in the base frame, each slowed by a damper and held to its rest position by a spring.

    Edges join the spheres of a deformable body. An edge pulls the difference of its ends' displacements from rest back
    to zero, in all directions alike. A sphere without a spring of its own must be joined to one that has.

    Raises
    ------
    InputError
        If a value is not finite, the shapes disagree, a radius, damping or edge stiffness is not positive, a stiffness
        is negative, an edge names a sphere that is not there, or a group of joined spheres has no spring to hold it.
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
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    """(E, 2) indices of the spheres that each edge joins."""
    edge_stiffness: Array = field(default_factory=lambda: np.zeros(0))
    """(E,) N/m."""

    def __post_init__(self) -> None:
        count = len(np.atleast_1d(self.radius))
        for name, shape in (("center", (count, 3)), ("rest", (count, 3))):
            object.__setattr__(self, name, _checked(f"sphere {name}", getattr(self, name), shape))
        edges = np.array(self.edges, dtype=np.intp).reshape(-1, 2)
        object.__setattr__(self, "edges", edges)
        sizes = {"radius": count, "stiffness": count, "damping": count, "edge_stiffness": len(edges)}
        for name, size in sizes.items():
            values = _checked(f"sphere {name}", getattr(self, name), (size,))
            if (values < 0.0).any() or (name != "stiffness" and (values == 0.0).any()):
                raise InputError(f"sphere {name}: expected positive values, got {values.min():g}")
            object.__setattr__(self, name, values)
        if edges.size and not (edges.min() >= 0 and edges.max() < count):
            raise InputError(
                f"sphere edges: expected indices from 0 to {count - 1}, got {edges.min()} to {edges.max()}"
            )
        self._check_held()

    def __len__(self) -> int:
        return len(self.radius)

    def _check_held(self) -> None:
        if (self.stiffness > 0.0).all():
            return
        count = len(self)
        graph = coo_array((np.ones(len(self.edges)), self.edges.T), shape=(count, count))
        groups, group = connected_components(graph, directed=False)
        held = np.zeros(groups, bool)
        held[group[self.stiffness > 0.0]] = True
        if not held.all():
            loose = int(np.flatnonzero(~held[group])[0])
            raise InputError(
                f"sphere stiffness: nothing holds sphere {loose}; expected a positive stiffness of it or of a sphere "
                "that edges join it to"
            )

    @classmethod
    def none(cls) -> Spheres:
        """No obstacles."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0))


class HeldReference(NamedTuple):
    """x_d and q_d that do not change with time."""

    position: Array
    """(3,), m."""
    rotation: Array
    """(3, 3)."""
    posture: Array
    """(7,), rad."""


class HeldTorque(NamedTuple):
    """A command τ − D q̇ beyond C + g that does not change with time, for plans of joint torques."""

    torque: Array
    """(7,) τ, N m."""
    damping: Array | None
    """(7,) diagonal of D, N m s/rad, or None for no damping."""


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

    @property
    def changes_ns(self) -> list[int]:
        """When what is in force changes, ns: the effect, the ends of the knots but the last, and the expiry."""
        return [self.effect_ns + knot * self.knot_duration_ns for knot in range(len(self.positions) + 1)]

    def in_force(self, time_ns: int) -> HeldReference | HeldTorque | None:
        """What holds at a time after the effect, ns; None once the plan has run out."""
        knot = (time_ns - self.effect_ns - 1) // self.knot_duration_ns
        if knot >= len(self.positions):
            return None
        return HeldReference(self.positions[knot], self.rotations[knot], self.postures[knot])


def _checked(name: str, values: object, shape: tuple[int, ...]) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite values, got {array.ravel().tolist()}")
    array.setflags(write=False)
    return array
