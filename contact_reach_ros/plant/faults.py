"""Faults on purpose: what can go wrong on a robot, as schedules that the simulation plays.

The classes below are the one table of kinds: their fields are the keys of a schedule, with unit, range and meaning.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.plant.plant import Plant, Push, Reading
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Setting, Settings, read_yaml, setting, unknown_key
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

_ALL = "all"
_FOR = "for"
_DURATION = "duration"
"""What the key `for` is called in Python, where that is no name."""
_KIND = "kind"
_LIST = "faults"
_YAML = (".yaml", ".yml")


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
        """The fault in the compact form that `parse_faults` reads; what has its default is left out."""
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
class _Shared(Fault):
    share: float = setting(1.0, "of the messages that it hits, drawn at random", minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class _Delayed(Fault):
    delay: float = setting(0.005, "added to the time on the way", unit="s", minimum=0.0, maximum=2.0)


@dataclass(frozen=True)
class _Duplicated(_Shared):
    after: float = setting(0.0, "the copy comes so much later", unit="s", minimum=0.0, maximum=2.0)


_JOINTS = (_ALL, *iiwa14.JOINT_NAMES)


@dataclass(frozen=True)
class DropCommands(_Shared):
    """Commands get lost."""

    KIND = "drop_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands get lost"


@dataclass(frozen=True)
class DelayCommands(_Delayed):
    """Commands come late."""

    KIND = "delay_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands come late, in their order"


@dataclass(frozen=True)
class DuplicateCommands(_Duplicated):
    """Commands come twice."""

    KIND = "duplicate_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands come twice"


@dataclass(frozen=True)
class NanCommands(_Shared):
    """Commands hold NaN."""

    KIND = "nan_commands"
    SEAM = Seam.COMMANDS
    MEANING = "commands hold NaN"

    joint: str = setting(_ALL, "whose torque it is", choices=_JOINTS)


@dataclass(frozen=True)
class DropStates(_Shared):
    """Joint states get lost."""

    KIND = "drop_states"
    SEAM = Seam.STATES
    MEANING = "joint states get lost"


@dataclass(frozen=True)
class DelayStates(_Delayed):
    """Joint states come late."""

    KIND = "delay_states"
    SEAM = Seam.STATES
    MEANING = "joint states come late, in their order"


@dataclass(frozen=True)
class DuplicateStates(_Duplicated):
    """Joint states come twice."""

    KIND = "duplicate_states"
    SEAM = Seam.STATES
    MEANING = "joint states come twice"


@dataclass(frozen=True)
class NanStates(_Shared):
    """Joint states hold NaN."""

    KIND = "nan_states"
    SEAM = Seam.STATES
    MEANING = "joint states hold NaN"

    field: str = setting("position", "which field", choices=("position", "velocity", "effort"))
    joint: str = setting(_ALL, "whose value it is", choices=_JOINTS)


@dataclass(frozen=True)
class VelocityNoise(Fault):
    """Noise on the velocities."""

    KIND = "velocity_noise"
    SEAM = Seam.SENSORS
    MEANING = "white noise on the velocities, besides the usual"

    deviation: float = setting(0.05, "standard deviation", unit="rad/s", minimum=0.0, maximum=10.0)
    joint: str = setting(_ALL, "whose", choices=_JOINTS)


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

    joint: str = setting(_ALL, "whose", choices=_JOINTS)
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


def parse_faults(text: str) -> Schedule:
    """A schedule from text such as ``push link=lbr_link_4 force="0 50 0" at=2 for=0.1; drop_commands share=0.3``.

    Parameters
    ----------
    text
        Faults separated by semicolons, each a kind and its keys; or the path of a YAML file, see `read_faults`. An
        empty text is an empty schedule.

    Raises
    ------
    SettingsError
        On an unknown kind or key, or a value that is not accepted; fault and key are named.
    """
    if text.strip().endswith(_YAML):
        return read_faults(Path(text.strip()))
    faults = []
    for number, part in enumerate((part.strip() for part in text.split(";")), 1):
        if not part:
            continue
        source = f"fault {number}"
        try:
            kind, *pairs = shlex.split(part)
        except ValueError as error:
            raise SettingsError(f"{source}, '{part}': {error}; expected 'kind key=value ...'") from error
        values: dict[str, Any] = {}
        for pair in pairs:
            key, equals, value = pair.partition("=")
            if not equals:
                raise SettingsError(f"{source}, '{pair}': expected key=value, quoted if the value holds blanks")
            if key in values:
                raise SettingsError(f"{source}: {key} is given twice")
            values[key] = value
        faults.append(_make(kind, values, source, _from_text))
    return tuple(faults)


def read_faults(file: Path) -> Schedule:
    """A schedule from a YAML file: a list `faults`, each with its `kind` and keys.

    Raises
    ------
    SettingsError
        If the file cannot be read or a fault is not accepted; file, fault and key are named.
    """
    content = read_yaml(file)
    for key in content:
        if key != _LIST:
            raise SettingsError(unknown_key(str(key), [_LIST], str(file)))
    entries = content.get(_LIST)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SettingsError(f"{file}: {_LIST} is no list of mappings; expected '- kind: push', and its keys below")
    faults = []
    for number, entry in enumerate(entries, 1):
        source = f"{file}: fault {number}"
        values = {str(key): value for key, value in entry.items()}
        if _KIND not in values:
            raise SettingsError(f"{source} has no kind; expected one of {', '.join(KINDS)}")
        faults.append(_make(str(values.pop(_KIND)), values, source, lambda value, _: value))
    return tuple(faults)


def _make(kind: str, values: Mapping[str, Any], source: str, convert: Callable[[Any, Setting], Any]) -> Fault:
    if kind not in KINDS:
        raise SettingsError(unknown_key(kind, KINDS, source).replace("unknown key", "unknown kind"))
    known = {public_key(entry): entry for entry in KINDS[kind].declared()}
    made: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            raise SettingsError(unknown_key(key, known, f"{source}, {kind}"))
        entry = known[key]
        made[entry.name] = entry.check(convert(value, entry), f"{source}, {kind}: {key}")
    return KINDS[kind](**made)


def _from_text(value: str, entry: Setting) -> Any:
    """The value that a text stands for; the text itself where it stands for none, which `check` then refuses."""
    if entry.kind is not float:
        return value
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:
        return value
    if entry.length is not None:
        return numbers
    return numbers[0] if len(numbers) == 1 else value


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


class State(NamedTuple):
    """Joint states as a message tells them: stamp in ns and what the sensors read."""

    stamp_ns: int
    reading: Reading

    @property
    def is_finite(self) -> bool:
        """Whether positions and velocities are numbers; anybody who reads the message refuses it otherwise."""
        return bool(np.isfinite(self.reading.position.sum() + self.reading.velocity.sum()))


Item = TypeVar("Item")
FaultType = TypeVar("FaultType", bound=Fault)


class _Line:
    """A way that messages take, with what goes wrong on it."""

    def __init__(
        self,
        drops: Sequence[_Shared],
        delays: Sequence[_Delayed],
        duplicates: Sequence[_Duplicated],
        random: np.random.Generator,
    ) -> None:
        self._drops, self._delays, self._duplicates = drops, delays, duplicates
        self._random = random
        self._under_way: list[tuple[int, int, Any]] = []
        self._order = itertools.count()
        self._last_due_ns = 0

    def send(self, item: Any, since_start: float, now_ns: int) -> None:
        for drop in self._drops:
            if drop.is_active(since_start) and self._random.random() < drop.share:
                return
        delay = sum(fault.delay for fault in self._delays if fault.is_active(since_start))
        # Not before what was sent earlier, which is still under way when a delay has just ended.
        self._last_due_ns = due_ns = max(now_ns + round(delay * NANOSECONDS), self._last_due_ns)
        heapq.heappush(self._under_way, (due_ns, next(self._order), item))
        for fault in self._duplicates:
            if fault.is_active(since_start) and self._random.random() < fault.share:
                copy_ns = due_ns + round(fault.after * NANOSECONDS)
                heapq.heappush(self._under_way, (copy_ns, next(self._order), item))

    def arrivals(self, now_ns: int) -> list[Any]:
        arrived = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            arrived.append(heapq.heappop(self._under_way)[2])
        return arrived


class Faults:
    """Plays a schedule: hand it what passes the seams, and call `act` before each step of the plant.

    Nothing happens before `start`. The same schedule and seed give the same faults. Times are those of the simulation.
    """

    def __init__(self, schedule: Schedule, seed: int, plant: Plant) -> None:
        """`plant`: with a spare obstacle if the schedule has an obstacle.

        Raises
        ------
        SettingsError
            If two obstacles would be there at the same time, or there is none to spare.
        """
        self.schedule = schedule
        self._plant = plant
        self._start_ns: int | None = None
        self._random = np.random.default_rng((seed, len(schedule)))
        self._commands = _Line(
            self._of(DropCommands), self._of(DelayCommands), self._of(DuplicateCommands), self._random
        )
        self._states = _Line(self._of(DropStates), self._of(DelayStates), self._of(DuplicateStates), self._random)
        self._nan_commands = self._of(NanCommands)
        self._nan_states = self._of(NanStates)
        self._noises, self._stuck = self._of(VelocityNoise), self._of(StuckEncoder)
        self._torque_sensors = self._of(TorqueSensor)
        self._frozen: dict[StuckEncoder, float] = {}
        self._plant_faults = [fault for fault in schedule if fault.SEAM is Seam.PLANT]
        self._acting: list[Fault] = []
        obstacles = sorted(self._of(Obstacle), key=lambda fault: fault.at)
        for first, second in itertools.pairwise(obstacles):
            if first.is_active(second.at):
                raise SettingsError("faults: two obstacles at the same time; there is one: end the first with `for`")
        if obstacles and not plant.has_spare_obstacle:
            raise SettingsError("faults: obstacle: the simulation was built without one to spare")

    def start(self, now_ns: int) -> None:
        """Begin: the times of the schedule count from now."""
        self._start_ns = now_ns

    def act(self, now_ns: int) -> None:
        """Let the faults of robot and surroundings act on the next step of the plant."""
        if self._plant_faults:
            self._change([fault for fault in self._plant_faults if self._is_active(fault, now_ns)])

    def end(self) -> None:
        """Undo what robot and surroundings suffer; messages under way are lost."""
        self._change([])

    def text(self) -> str:
        """The schedule in the compact form."""
        return "; ".join(fault.text() for fault in self.schedule)

    def send_command(self, torque: Array, now_ns: int) -> None:
        """Put a command (7,), N m, on its way to the drive."""
        for fault in self._nan_commands:
            if self._is_active(fault, now_ns) and self._random.random() < fault.share:
                torque = _spoilt(torque, fault.joint)
        self._commands.send(torque, self._since_start(now_ns), now_ns)

    def commands(self, now_ns: int) -> list[Array]:
        """The commands that reach the drive now, in their order."""
        return self._commands.arrivals(now_ns)

    def send_state(self, reading: Reading, now_ns: int) -> None:
        """Put what the sensors read now on its way to controller, observer and planner."""
        reading = self._sensed(reading, now_ns)
        for fault in self._nan_states:
            if self._is_active(fault, now_ns) and self._random.random() < fault.share:
                name = "torque" if fault.field == "effort" else fault.field
                reading = dataclasses.replace(reading, **{name: _spoilt(getattr(reading, name), fault.joint)})
        jump = sum(fault.step for fault in self._of(ClockJump) if self._is_active(fault, now_ns))
        state = State(now_ns + round(jump * NANOSECONDS), reading)
        self._states.send(state, self._since_start(now_ns), now_ns)

    def states(self, now_ns: int) -> list[State]:
        """The joint states that arrive now, in their order."""
        return self._states.arrivals(now_ns)

    def silent(self, kind: type[Fault], now_ns: int) -> bool:
        """Whether a node is silenced by `PlannerSilent`, `ObserverSilent` or `ControllerSilent`."""
        return any(self._is_active(fault, now_ns) for fault in self._of(kind))

    def plan_delay(self, now_ns: int) -> float:
        """How late a plan made now comes, s."""
        return sum(fault.delay for fault in self._of(LatePlans) if self._is_active(fault, now_ns))

    def _change(self, acting: list[Fault]) -> None:
        """Let these faults act on robot and surroundings, and no others."""
        if acting == self._acting:
            return
        self._acting = acting
        plant = self._plant
        plant.set_payload(sum(fault.mass for fault in acting if isinstance(fault, Payload)))
        plant.scale_friction(_product(fault.factor for fault in acting if isinstance(fault, Friction)))
        plant.scale_foam(_product(fault.factor for fault in acting if isinstance(fault, StifferFoam)))
        plant.set_pushes(
            [
                Push(fault.link, np.array(fault.force), np.array(fault.point))
                for fault in acting
                if isinstance(fault, ExternalPush)
            ]
        )
        obstacle = next((fault for fault in acting if isinstance(fault, Obstacle)), None)
        if obstacle is not None:
            plant.place_spare_obstacle(np.array(obstacle.position), obstacle.radius, obstacle.stiffness)
        elif plant.has_spare_obstacle:
            plant.remove_spare_obstacle()

    def _of(self, kind: type[FaultType]) -> list[FaultType]:
        return [fault for fault in self.schedule if isinstance(fault, kind)]

    def _since_start(self, now_ns: int) -> float:
        """Seconds since `start`; before it a time at which nothing acts."""
        return -1.0 if self._start_ns is None else (now_ns - self._start_ns) / NANOSECONDS

    def _is_active(self, fault: Fault, now_ns: int) -> bool:
        return fault.is_active(self._since_start(now_ns))

    def _sensed(self, reading: Reading, now_ns: int) -> Reading:
        if not (self._noises or self._stuck or self._torque_sensors):
            return reading
        position, velocity, torque = reading.position.copy(), reading.velocity.copy(), reading.torque.copy()
        for noise in self._noises:
            if self._is_active(noise, now_ns):
                joints = _joints(noise.joint)
                velocity[joints] += noise.deviation * self._random.standard_normal(iiwa14.N_JOINTS)[joints]
        for stuck in self._stuck:
            if self._is_active(stuck, now_ns):
                joint = iiwa14.joint_index(stuck.joint)
                position[joint] = self._frozen.setdefault(stuck, float(position[joint]))
                if stuck.velocity == "zero":
                    velocity[joint] = 0.0
        for sensor in self._torque_sensors:
            if self._is_active(sensor, now_ns):
                joints = _joints(sensor.joint)
                torque[joints] = sensor.gain * torque[joints] + sensor.bias
        return Reading(position, velocity, torque)


def _joints(name: str) -> slice:
    if name == _ALL:
        return slice(None)
    joint = iiwa14.joint_index(name)
    return slice(joint, joint + 1)


def _spoilt(values: Array, joint: str) -> Array:
    spoilt = values.copy()
    spoilt[_joints(joint)] = np.nan
    return spoilt


def _product(factors: Iterable[float]) -> float:
    return float(np.prod(list(factors)))
