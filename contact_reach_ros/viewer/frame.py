"""One moment as shown on the page, from topics or from a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from contact_reach_ros.arrays import Array
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.world.spheres import Spheres


class SafetyLevel(Enum):
    """Level of a safety_state message, from good to bad."""

    OK = 0
    CONTACT = 1
    STOP = 2


@dataclass(frozen=True)
class SafetyStatus:
    """Safety state of one node."""

    level: SafetyLevel
    message: str
    contact: Contact | None = None
    """Contact that the observer has located, if any."""


@dataclass(frozen=True)
class Frame:
    """One moment; what is unknown is None.

    Attributes
    ----------
    time
        Time on the robot's clock, s.
    q
        (n,) joint angles, rad.
    external_torque
        (n,), Nm.
    obstacles
        Spheres and the edges of deformable bodies.
    plan
        The newest plan; None also after a stop or the end of a goal has withdrawn it.
    forces
        True contact force on each link by its name, N; only the simulation knows them.
    goal
        (3,), m.
    safety
        Safety state by the name of the node.
    """

    time: float
    q: Array
    external_torque: Array | None = None
    obstacles: Spheres | None = None
    plan: PlanPicture | None = None
    forces: Mapping[str, float] = field(default_factory=dict)
    goal: Array | None = None
    safety: Mapping[str, SafetyStatus] = field(default_factory=dict)

    def stops(self) -> dict[str, str]:
        """Reasons for the latched stops, by node."""
        return {name: status.message for name, status in self.safety.items() if status.level is SafetyLevel.STOP}
