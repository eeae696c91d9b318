"""The table of fault kinds: where each acts, its keys in a schedule, and the function that acts.

Parsing, documentation and execution all follow from `fault_kinds`.
"""

from __future__ import annotations

import dataclasses
import functools
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.settings import Setting, Value
from contact_reach_ros.simulation.plant import Push
from contact_reach_ros.units import NANOSECONDS

ALL_JOINTS = "all"
"""Value of the key `joint` that stands for every joint."""

PAUSE, OBSTACLE = "pause", "obstacle"
LATE_PLANS, FALSE_PLANS, OTHER_GAINS = "late_plans", "false_plans", "other_gains"
PLANNER_SILENT, OBSERVER_SILENT, CONTROLLER_SILENT = "planner_silent", "observer_silent", "controller_silent"
"""Kinds that the code that runs plant and nodes carries out."""

_RIVAL_LAG = 500_000
"""Time by which a second publisher's message follows the first one's, ns."""


class Seam(Enum):
    """Where a fault acts."""

    DRIVER = "driver"
    COMMANDS = "commands on their way to the drive"
    SENSORS = "joint sensors"
    STATES = "joint states on their way to controller, observer and planner"
    CLOCK = "stamps of joint states"
    OBSTACLES = "obstacles on their way to the planner"
    PLANT = "robot and surroundings"
    NODES = "other nodes"


def _nothing(fault: Fault, target: Any, context: Context) -> None:
    pass


@dataclass(frozen=True)
class Kind:
    """One row of the table.

    Attributes
    ----------
    own_keys
        Keys besides `at` and `for`.
    act
        Changes a `Message`, or `Surroundings` at the seam PLANT, while a fault of this kind is active. At the seams
        DRIVER and NODES it does nothing: whoever runs them queries `Faults`.
    """

    name: str
    seam: Seam
    meaning: str
    own_keys: tuple[Setting, ...] = ()
    act: Callable[[Fault, Any, Context], None] = _nothing

    @functools.cached_property
    def keys(self) -> dict[str, Setting]:
        """All keys by name."""
        return {key.name: key for key in (*_TIMES, *self.own_keys)}


@dataclass(frozen=True)
class Fault:
    """One fault of a schedule; `fault["at"]` is the value of a key."""

    kind: Kind
    values: Mapping[str, Value] = field(hash=False)
    """Values of all keys of the kind."""

    @property
    def name(self) -> str:
        """Name of the kind."""
        return self.kind.name

    def __getitem__(self, key: str) -> Any:
        return self.values[key]

    def is_active(self, since_start: float) -> bool:
        """Whether it acts, at a time in s since the start of the schedule."""
        at, duration = self["at"], self["for"]
        # Rounded to ns, in which times are counted: 0.1 + 0.2 is more than 0.3.
        return bool(at <= since_start and (duration == 0.0 or since_start < round(at + duration, 9)))

    def text(self) -> str:
        """The fault as text for `parse_faults`, without the keys that have their defaults."""
        words = [self.name]
        for name, key in self.kind.keys.items():
            if self[name] != key.default:
                words.append(f"{name}={shlex.quote(_shown(self[name]))}")
        return " ".join(words)


Schedule = tuple[Fault, ...]


@dataclass(frozen=True)
class Context:
    """State shared by the faults of one simulation: arm, random numbers, and what is stuck where, rad or ns."""

    arm: Arm
    random: np.random.Generator
    stuck_at: dict[Fault, float] = field(default_factory=dict)

    def joints(self, fault: Fault) -> slice:
        """Joints that a fault affects: one, or all."""
        if fault["joint"] == ALL_JOINTS:
            return slice(None)
        index = self.arm.joint_index(fault["joint"])
        return slice(index, index + 1)


@dataclass
class Message:
    """A command, a joint state or obstacles in transit, which the faults change in place.

    Attributes
    ----------
    values
        'effort' (n,), N m, unless it is left out; for a joint state also 'position' (n,), rad, and 'velocity' (n,),
        rad/s; nothing for obstacles.
    stamp_ns
        Stamp of a joint state, ns.
    delay
        Time in transit, s.
    copies
        Delay of each copy, s.
    rivals
        What other publishers send at the same time.
    """

    values: dict[str, Array]
    stamp_ns: int = 0
    delay: float = 0.0
    is_lost: bool = False
    copies: list[float] = field(default_factory=list)
    rivals: list[Message] = field(default_factory=list)


@dataclass
class Surroundings:
    """Sum of the changes to the plant by the active faults.

    Attributes
    ----------
    payload
        Additional mass at the flange, kg.
    friction, foam
        Factors on joint friction and on the stiffness of obstacles.
    obstacle
        Position (3,), m, base frame, radius, m, and stiffness, N/m, of the sphere that appears.
    """

    payload: float = 0.0
    friction: float = 1.0
    foam: float = 1.0
    pushes: list[Push] = field(default_factory=list)
    obstacle: tuple[Array, float, float] | None = None


def _drop(fault: Fault, message: Message, context: Context) -> None:
    message.is_lost = True


def _delay(fault: Fault, message: Message, context: Context) -> None:
    message.delay += fault["delay"]


def _duplicate(fault: Fault, message: Message, context: Context) -> None:
    message.copies.append(fault["after"])


def _spoil(fault: Fault, message: Message, context: Context) -> None:
    message.values[str(fault.values.get("field", "effort"))][context.joints(fault)] = np.nan


def _noise(fault: Fault, message: Message, context: Context) -> None:
    joints = context.joints(fault)
    message.values["velocity"][joints] += fault["deviation"] * context.random.standard_normal(context.arm.n)[joints]


def _stick(fault: Fault, message: Message, context: Context) -> None:
    joint, position = context.arm.joint_index(fault["joint"]), message.values["position"]
    position[joint] = context.stuck_at.setdefault(fault, float(position[joint]))
    if fault["velocity"] == "zero":
        message.values["velocity"][joint] = 0.0


def _falsify(fault: Fault, message: Message, context: Context) -> None:
    joints, torque = context.joints(fault), message.values["effort"]
    torque[joints] = fault["gain"] * torque[joints] + fault["bias"]


def _omit(fault: Fault, message: Message, context: Context) -> None:
    del message.values["effort"]


def _command_too(fault: Fault, message: Message, context: Context) -> None:
    message.rivals.append(Message({"effort": np.full(context.arm.n, fault["torque"])}))


def _report_too(fault: Fault, message: Message, context: Context) -> None:
    values = {name: array.copy() for name, array in message.values.items()}
    values["position"] += fault["offset"]
    message.rivals.append(Message(values, message.stamp_ns + _RIVAL_LAG))


def _jump(fault: Fault, message: Message, context: Context) -> None:
    message.stamp_ns += round(fault["step"] * NANOSECONDS)


def _freeze(fault: Fault, message: Message, context: Context) -> None:
    message.stamp_ns = int(context.stuck_at.setdefault(fault, message.stamp_ns))


def _load(fault: Fault, surroundings: Surroundings, context: Context) -> None:
    surroundings.payload += fault["mass"]


def _rub(fault: Fault, surroundings: Surroundings, context: Context) -> None:
    surroundings.friction *= fault["factor"]


def _stiffen(fault: Fault, surroundings: Surroundings, context: Context) -> None:
    surroundings.foam *= fault["factor"]


def _place(fault: Fault, surroundings: Surroundings, context: Context) -> None:
    surroundings.obstacle = np.array(fault["position"]), fault["radius"], fault["stiffness"]


def _push(fault: Fault, surroundings: Surroundings, context: Context) -> None:
    surroundings.pushes.append(Push(fault["link"], np.array(fault["force"]), np.array(fault["point"])))


def _number(
    name: str, default: float | tuple[float, ...], description: str, limits: tuple[float, float], unit: str = ""
) -> Setting:
    """Declare a number or a list of numbers."""
    return Setting(name, default, description, unit, *limits, choices=(), optional_length=None, per_joint=False)


def _choice(name: str, default: str, description: str, choices: tuple[str, ...]) -> Setting:
    return Setting(name, default, description, "", None, None, choices, optional_length=None, per_joint=False)


_TIMES = (
    _number(
        "at",
        0.0,
        "begin: after the goal in an episode; in the driver after its activation, or after the schedule's arrival",
        (0, 3600),
        "s",
    ),
    _number("for", 0.0, "duration; 0: until the end", (0, 3600), "s"),
)
_SHARE = _number("share", 1.0, "share of the messages affected, drawn at random", (0, 1))
_DELAY = _number("delay", 0.005, "additional time in transit", (0, 2), "s")
_PLAN_DELAY = dataclasses.replace(_DELAY, default=0.1)
_AFTER = _number("after", 0.0, "time from the original to its copy", (0, 2), "s")
_FIELD = _choice("field", "position", "affected field", ("position", "velocity", "effort"))
_DEVIATION = _number("deviation", 0.05, "standard deviation", (0, 10), "rad/s")
_VELOCITY = _choice("velocity", "zero", "reported velocity: zero, like the encoder's, or true", ("zero", "true"))
_GAIN = _number("gain", 1.0, "factor; -1 inverts the sign", (-10, 10))
_BIAS = _number("bias", 0.0, "offset", (-320, 320), "Nm")
_TORQUE = _number("torque", 0.0, "on every joint", (-320, 320), "Nm")
_ANGLE = _number("offset", 0.5, "of every joint from the true one", (-3, 3), "rad")
_STEP = _number("step", 1.0, "forward, or back if negative", (-100, 100), "s")
_MASS = _number("mass", 1.0, "mass of the payload", (0, 14), "kg")
_FRICTION = _number("factor", 3.0, "factor on both", (0, 50))
_FOAM = _number("factor", 2.0, "factor on all", (0.1, 5))
_POSITION = _number("position", (0.6, 0.0, 0.3), "centre, base frame", (-1.5, 1.5), "m")
_RADIUS = _number("radius", 0.05, "radius of the sphere", (0.005, 0.5), "m")
_STIFFNESS = _number("stiffness", 5000.0, "contact stiffness", (50, 50000), "N/m")
_FORCE = _number("force", (0.0, 50.0, 0.0), "in the base frame", (-1000, 1000), "N")
_OFFSET = _number("offset", (0.0, 0.0, 0.0), "of every x_d, base frame", (-10, 10), "m")
_STRETCH = _number("stretch", 1.0, "factor on the duration", (0.1, 1000))
_GAIN_FACTOR = _number("factor", 0.5, "factor on the task stiffness", (0, 2))
_POINT = _number("point", (0.0, 0.0, 0.0), "in the frame of the link", (-1, 1), "m")


@functools.cache
def fault_kinds(arm: Arm) -> dict[str, Kind]:
    """All kinds by name, in the order in which they act."""
    joint = _choice("joint", ALL_JOINTS, "affected joint", (ALL_JOINTS, *arm.joint_names))
    one_joint = _choice("joint", arm.joint_names[arm.n // 4], "affected joint", arm.joint_names)
    link = _choice("link", arm.link_names[arm.n // 2], "affected link", arm.link_names)
    driver, commands, sensors, states, clock, obstacles, plant, nodes = Seam
    kinds = (
        Kind(PAUSE, driver, "brakes closed and no joint states, as in an emergency stop; then the drive is reset"),
        Kind("nan_commands", commands, "commands contain NaN", (_SHARE, joint), _spoil),
        Kind("drop_commands", commands, "commands get lost", (_SHARE,), _drop),
        Kind("delay_commands", commands, "commands arrive late, in order", (_DELAY,), _delay),
        Kind("duplicate_commands", commands, "commands arrive twice", (_SHARE, _AFTER), _duplicate),
        Kind("foreign_commands", commands, "another node commands, too, behind each command", (_TORQUE,), _command_too),
        Kind("velocity_noise", sensors, "additional white noise on the velocities", (_DEVIATION, joint), _noise),
        Kind("stuck_encoder", sensors, "a joint's position stays at its first value", (one_joint, _VELOCITY), _stick),
        Kind("torque_sensor", sensors, "measured torques are gain × torque + bias", (joint, _GAIN, _BIAS), _falsify),
        Kind("nan_states", states, "joint states contain NaN", (_SHARE, _FIELD, joint), _spoil),
        Kind("no_effort", states, "joint states carry no efforts", (_SHARE,), _omit),
        Kind("drop_states", states, "joint states get lost", (_SHARE,), _drop),
        Kind("delay_states", states, "joint states arrive late, in order", (_DELAY,), _delay),
        Kind("duplicate_states", states, "joint states arrive twice", (_SHARE, _AFTER), _duplicate),
        Kind(
            "foreign_states", states, "another node reports joint states, too, half a ms later", (_ANGLE,), _report_too
        ),
        Kind("clock_jump", clock, "stamps of joint states are off by a step", (_STEP,), _jump),
        Kind("frozen_clock", clock, "the stamp of joint states stays at its first value", (), _freeze),
        Kind("drop_obstacles", obstacles, "what is seen of the obstacles gets lost", (_SHARE,), _drop),
        Kind("payload", plant, "a mass 5 cm in front of the flange that no model includes", (_MASS,), _load),
        Kind("friction", plant, "factor on viscous and dry friction of the joints", (_FRICTION,), _rub),
        Kind("foam", plant, "factor on all stiffnesses of balls and walls", (_FOAM,), _stiffen),
        Kind(
            OBSTACLE,
            plant,
            "a fixed sphere appears that is unknown to the planner; one at a time",
            (_POSITION, _RADIUS, _STIFFNESS),
            _place,
        ),
        Kind("push", plant, "a force acts on a point of a link", (link, _FORCE, _POINT), _push),
        Kind(PLANNER_SILENT, nodes, "the planner does nothing, as if killed or frozen"),
        Kind(OBSERVER_SILENT, nodes, "the observer does nothing, as if killed or frozen"),
        Kind(CONTROLLER_SILENT, nodes, "the controller does nothing, as if killed or frozen"),
        Kind(LATE_PLANS, nodes, "plans arrive late, made for an earlier time", (_PLAN_DELAY,)),
        Kind(FALSE_PLANS, nodes, "plans lead elsewhere, or last longer, than planned", (_OFFSET, _STRETCH)),
        Kind(OTHER_GAINS, nodes, "the planner reports other gains than the controller has", (_GAIN_FACTOR,)),
    )
    return {kind.name: kind for kind in kinds}


def kinds_table(arm: Arm) -> str:
    """All kinds and keys, in Markdown."""
    lines = ["| kind | acts on | what happens | keys besides `at` and `for` |", "|---|---|---|---|"]
    for kind in fault_kinds(arm).values():
        keys = [f"`{key.name}` = {_shown(key.default)}: {key.description}; {key.accepts}" for key in kind.own_keys]
        lines.append(f"| `{kind.name}` | {kind.seam.value} | {kind.meaning} | {'<br>'.join(keys) or 'none'} |")
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{item:g}" for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
