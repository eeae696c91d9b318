"""What can go wrong on a robot: the one table of fault kinds.

The fields of the classes below are the keys of a schedule, with unit, range and meaning.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Setting, Settings, setting

ALL_JOINTS = "all"
"""In the place of a joint's name."""

_FOR = "for"
_DURATION = "duration"
"""What the key `for` is called in Python, where that is no name."""


class Seam(Enum):
    """Where a fault acts."""

    COMMANDS = "commands on their way to the drive"
    STATES = "joint states on their way to controller, observer and planner"
    SENSORS = "joint sensors"
    PLANT = "robot and surroundings"
    CLOCK = "stamps of joint states"
    NODES = "other nodes"


@dataclass(frozen=True)
class Fault(Settings):
    """What all kinds have in common."""

    KIND: ClassVar[str]
    SEAM: ClassVar[Seam]
    MEANING: ClassVar[str]

    at: float = setting(
        0.0,
        "begin: after the goal in an episode; in the driver after its activation, or after the schedule came",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
    )
    duration: float = setting(0.0, "how long; 0: to the end", unit="s", minimum=0.0, maximum=3600.0)

    def is_active(self, since_start: float) -> bool:
        """Whether it acts at a time in s after the start of the schedule."""
        # Rounded to ns, which times are counted in: 0.1 + 0.2 is more than 0.3.
        return self.at <= since_start and (self.duration == 0.0 or since_start < round(self.at + self.duration, 9))

    def text(self) -> str:
        """The fault in the compact form that `fault_schedules.parse_faults` reads; what has its default is left out."""
        words = [self.KIND]
        for entry in self.declared():
            value = getattr(self, entry.name)
            if value != entry.default:
                shown = " ".join(f"{item:g}" for item in value) if isinstance(value, tuple) else _plain(value)
                words.append(f"{public_key(entry)}={shlex.quote(shown)}")
        return " ".join(words)


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class SharedFault(Fault):
    """Hits a share of the messages."""

    share: float = setting(1.0, "of the messages that it hits, drawn at random", minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class DelayedFault(Fault):
    """Holds messages up."""

    delay: float = setting(0.005, "added to the time on the way", unit="s", minimum=0.0, maximum=2.0)


@dataclass(frozen=True)
class DuplicatedFault(SharedFault):
    """Sends messages twice."""

    after: float = setting(0.0, "the copy comes so much later", unit="s", minimum=0.0, maximum=2.0)


_JOINTS = (ALL_JOINTS, *iiwa14.JOINT_NAMES)


@dataclass(frozen=True)
class DropCommands(SharedFault):
    """Commands get lost."""

    KIND = "drop_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands get lost"


@dataclass(frozen=True)
class DelayCommands(DelayedFault):
    """Commands come late."""

    KIND = "delay_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands come late, in their order"


@dataclass(frozen=True)
class DuplicateCommands(DuplicatedFault):
    """Commands come twice."""

    KIND = "duplicate_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands come twice"


@dataclass(frozen=True)
class NanCommands(SharedFault):
    """Commands hold NaN."""

    KIND = "nan_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands hold NaN"

    joint: str = setting(ALL_JOINTS, "whose torque it is", choices=_JOINTS)


@dataclass(frozen=True)
class DropStates(SharedFault):
    """Joint states get lost."""

    KIND = "drop_states"
    SEAM = Seam.STATES
    MEANING = "joint states get lost"


@dataclass(frozen=True)
class DelayStates(DelayedFault):
    """Joint states come late."""

    KIND = "delay_states"
    SEAM = Seam.STATES
    MEANING = "joint states come late, in their order"


@dataclass(frozen=True)
class DuplicateStates(DuplicatedFault):
    """Joint states come twice."""

    KIND = "duplicate_states"
    SEAM = Seam.STATES
    MEANING = "joint states come twice"


@dataclass(frozen=True)
class NanStates(SharedFault):
    """Joint states hold NaN."""

    KIND = "nan_states"
    SEAM = Seam.STATES
    MEANING = "joint states hold NaN"

    field: str = setting("position", "which field", choices=("position", "velocity", "effort"))
    joint: str = setting(ALL_JOINTS, "whose value it is", choices=_JOINTS)


@dataclass(frozen=True)
class VelocityNoise(Fault):
    """Noise on the velocities."""

    KIND = "velocity_noise"
    SEAM = Seam.SENSORS
    MEANING = "white noise on the velocities, besides the usual"

    deviation: float = setting(0.05, "standard deviation", unit="rad/s", minimum=0.0, maximum=10.0)
    joint: str = setting(ALL_JOINTS, "whose", choices=_JOINTS)


@dataclass(frozen=True)
class StuckEncoder(Fault):
    """A joint's position freezes."""

    KIND = "stuck_encoder"
    SEAM = Seam.SENSORS
    MEANING = "a joint's position stays what it was at the beginning"

    joint: str = setting("lbr_A2", "whose", choices=iiwa14.JOINT_NAMES)
    velocity: str = setting(
        "zero", "what is said of its velocity: zero, as from the same encoder, or the truth", choices=("zero", "true")
    )


@dataclass(frozen=True)
class TorqueSensor(Fault):
    """A joint torque sensor is wrong."""

    KIND = "torque_sensor"
    SEAM = Seam.SENSORS
    MEANING = "measured torques are gain × torque + bias"

    joint: str = setting(ALL_JOINTS, "whose", choices=_JOINTS)
    gain: float = setting(1.0, "-1 for the wrong sign", minimum=-10.0, maximum=10.0)
    bias: float = setting(0.0, "offset", unit="Nm", minimum=-320.0, maximum=320.0)


@dataclass(frozen=True)
class Payload(Fault):
    """Something is picked up."""

    KIND = "payload"
    SEAM = Seam.PLANT
    MEANING = "a mass 5 cm before the flange that no model knows"

    mass: float = setting(1.0, "of the payload", unit="kg", minimum=0.0, maximum=14.0)


@dataclass(frozen=True)
class Friction(Fault):
    """Joint friction changes."""

    KIND = "friction"
    SEAM = Seam.PLANT
    MEANING = "factor on viscous and dry friction of the joints"

    factor: float = setting(3.0, "on both", minimum=0.0, maximum=50.0)


@dataclass(frozen=True)
class StifferFoam(Fault):
    """The obstacles get stiffer."""

    KIND = "foam"
    SEAM = Seam.PLANT
    MEANING = "factor on all stiffnesses of balls and walls"

    factor: float = setting(2.0, "on all", minimum=0.1, maximum=5.0)


@dataclass(frozen=True)
class Obstacle(Fault):
    """A sphere appears that the planner is not told of."""

    KIND = "obstacle"
    SEAM = Seam.PLANT
    MEANING = "a sphere that does not give way stands there, and the planner is not told; one at a time"

    position: tuple[float, ...] = setting(
        (0.6, 0.0, 0.3), "its centre, base frame", unit="m", minimum=-1.5, maximum=1.5
    )
    radius: float = setting(0.05, "of the sphere", unit="m", minimum=0.005, maximum=0.5)
    stiffness: float = setting(5000.0, "of the contact", unit="N/m", minimum=50.0, maximum=50000.0)


@dataclass(frozen=True)
class ExternalPush(Fault):
    """A known force on a link."""

    KIND = "push"
    SEAM = Seam.PLANT
    MEANING = "a force on a point of a link"

    link: str = setting("lbr_link_4", "that is pushed", choices=iiwa14.LINK_NAMES)
    force: tuple[float, ...] = setting((0.0, 50.0, 0.0), "in the base frame", unit="N", minimum=-1000.0, maximum=1000.0)
    point: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "where, in the frame of the link", unit="m", minimum=-1.0, maximum=1.0
    )


@dataclass(frozen=True)
class ClockJump(Fault):
    """Stamps jump."""

    KIND = "clock_jump"
    SEAM = Seam.CLOCK
    MEANING = "stamps of joint states are off by a step"

    step: float = setting(1.0, "forth, or back if negative", unit="s", minimum=-100.0, maximum=100.0)


@dataclass(frozen=True)
class PlannerSilent(Fault):
    """No plans."""

    KIND = "planner_silent"
    SEAM = Seam.NODES
    MEANING = "the planner does nothing, as if killed or frozen"


@dataclass(frozen=True)
class ObserverSilent(Fault):
    """No observer."""

    KIND = "observer_silent"
    SEAM = Seam.NODES
    MEANING = "the observer does nothing, as if killed or frozen"


@dataclass(frozen=True)
class ControllerSilent(Fault):
    """No commands."""

    KIND = "controller_silent"
    SEAM = Seam.NODES
    MEANING = "the controller does nothing, as if killed or frozen"


@dataclass(frozen=True)
class LatePlans(Fault):
    """Plans come after the time that they were made for."""

    KIND = "late_plans"
    SEAM = Seam.NODES
    MEANING = "plans come late, made for an earlier time"

    delay: float = setting(0.1, "added to the time on the way", unit="s", minimum=0.0, maximum=2.0)


KINDS: dict[str, type[Fault]] = {
    kind.KIND: kind
    for kind in (
        DropCommands,
        DelayCommands,
        DuplicateCommands,
        NanCommands,
        DropStates,
        DelayStates,
        DuplicateStates,
        NanStates,
        VelocityNoise,
        StuckEncoder,
        TorqueSensor,
        Payload,
        Friction,
        StifferFoam,
        Obstacle,
        ExternalPush,
        ClockJump,
        PlannerSilent,
        ObserverSilent,
        ControllerSilent,
        LatePlans,
    )
}
"""All kinds by name."""

Schedule = tuple[Fault, ...]


def public_key(entry: Setting) -> str:
    """What a value is called in a schedule."""
    return _FOR if entry.name == _DURATION else entry.name


def kinds_table() -> str:
    """All kinds and keys, in Markdown."""
    lines = ["| kind | acts on | what happens | keys besides `at` and `for` |", "|---|---|---|---|"]
    common = {entry.name for entry in Fault.declared()}
    for name, kind in KINDS.items():
        keys = [
            f"`{entry.name}` = {_shown(entry.default)}: {entry.description}; {entry.accepts}"
            for entry in kind.declared()
            if entry.name not in common
        ]
        lines.append(f"| `{name}` | {kind.SEAM.value} | {kind.MEANING} | {'<br>'.join(keys) or 'none'} |")
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    return " ".join(f"{item:g}" for item in value) if isinstance(value, tuple) else _plain(value)
