"""One moment as shown on the page, from topics or from a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.messages.safety_state import ERROR, WARN, is_stopped, read_contact, read_level
from contact_reach_ros.observer.location import Contact
from contact_reach_ros.world.spheres import Spheres


@dataclass(frozen=True)
class SafetyStatus:
    """Safety state of one node, with the contact that the observer has located, if any.

    The level is OK, WARN for a contact, or ERROR for a stop.
    """

    level: int
    message: str
    contact: Contact | None = None


def safety_status(message: Any, arm: Arm) -> SafetyStatus:
    """The state of a node in a safety_state message, or any object with its fields; leaves out a malformed contact."""
    try:
        contact = read_contact(message, arm)
    except InputError:
        contact = None
    level = ERROR if is_stopped(message) else min(read_level(message), WARN)
    return SafetyStatus(level, message.message, contact)


@dataclass(frozen=True)
class Frame:
    """One moment; unknown parts are None.

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
