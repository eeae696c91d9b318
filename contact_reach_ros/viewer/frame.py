"""What the page shows of one moment, whether it comes from topics or from a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.observer.location import Contact
from contact_reach_ros.planning.problem import Spheres

Array = NDArray[np.float64]


class Level(Enum):
    """How a safety state is meant, from good to bad."""

    OK = 0
    CONTACT = 1
    STOP = 2


@dataclass(frozen=True)
class Status:
    """Newest safety state of one node."""

    level: Level
    message: str
    contact: Contact | None = None
    """Where the observer believes the arm to be touched."""


@dataclass(frozen=True)
class PlanPicture:
    """What a plan expects.

    Attributes
    ----------
    flange, elbow
        (n, 3) positions at the knots, m.
    ghost_starts, ghost_ends
        (k, 3) ends of the axes of the arm's cylinders at the last knot, m.
    ghost_radii
        (k,), m.
    """

    flange: Array
    elbow: Array
    ghost_starts: Array
    ghost_ends: Array
    ghost_radii: Array


@dataclass(frozen=True)
class Frame:
    """One moment. What is not known is None.

    Attributes
    ----------
    time
        On the robot's clock, s.
    q
        (7,) joint angles, rad.
    external_torque
        (7,), Nm.
    obstacles
        Spheres and the edges of deformable bodies.
    plan
        The newest one; None also when a stop or the end of a goal has withdrawn it.
    forces
        True contact force of links by their names, N; only simulation knows them.
    goal
        (3,), m.
    safety
        By the name of the node.
    """

    time: float
    q: Array
    external_torque: Array | None = None
    obstacles: Spheres | None = None
    plan: PlanPicture | None = None
    forces: Mapping[str, float] = field(default_factory=dict)
    goal: Array | None = None
    safety: Mapping[str, Status] = field(default_factory=dict)

    def stops(self) -> dict[str, str]:
        """Reasons of the stops that are latched, by node."""
        return {name: status.message for name, status in self.safety.items() if status.level is Level.STOP}
