"""A simulated robot with faults: what goes wrong, when, and what it does to messages, robot and surroundings.

`FaultyRobot(scene, [Push("lbr_link_4", (0.0, 50.0, 0.0), at=2.0, duration=0.1)])` has some.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import mujoco
import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState, checked_torque
from contact_reach_ros.arm.mjcf import PAYLOAD_CENTER, PAYLOAD_INERTIA
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.simulation.obstacles import obstacle_bodies, soften_fixed
from contact_reach_ros.simulation.plant import FRICTION, Plant
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.timing import NANOSECONDS
from contact_reach_ros.world.obstacle import BallSettings
from contact_reach_ros.world.scene import Scene

Vector = tuple[float, float, float]
Item = TypeVar("Item")


@dataclass
class Message:
    """A command, a joint state or an observation of the obstacles in transit; faults change it in place."""

    values: dict[str, Array]
    """'effort' (n,), N m; for a joint state also 'position' (n,), rad, and 'velocity' (n,), rad/s; nothing for
    obstacles."""
    stamp_ns: int = 0
    """Stamp of a joint state, ns."""
    delay: float = 0.0
    """Time in transit, s."""
    is_lost: bool = False
    has_effort: bool = True


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Begins `at` s after the start of the faults, which is the goal in an episode, and lasts for `duration` s."""

    at: float = 0.0
    duration: float = math.inf

    def __post_init__(self) -> None:
        if not (0.0 <= self.at < math.inf and self.duration > 0.0):
            raise SettingsError(f"{self}: expected at >= 0 s and duration > 0 s")

    def is_active(self, since_start: float) -> bool:
        """Whether the fault acts, at a time in s since the start."""
        # Rounded to ns, in which times are counted: 0.1 + 0.2 is more than 0.3.
        return self.at <= since_start < round(self.at + self.duration, 9)


@dataclass(frozen=True)
class MessageFault(Fault):
    """A fault of a random share of some messages; faults act in the order in which they are given."""

    what: str
    share: float = field(default=1.0, kw_only=True)
    CHOICES: ClassVar[Sequence[str]] = ("commands", "states")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.what not in self.CHOICES or not 0.0 < self.share <= 1.0:
            raise SettingsError(f"{self}: expected {' or '.join(self.CHOICES)}, and a share in (0, 1]")


@dataclass(frozen=True)
class Lost(MessageFault):
    """Commands, joint states, their efforts, or observations of the obstacles get lost."""

    CHOICES = ("commands", "states", "efforts", "obstacles")


@dataclass(frozen=True)
class Late(MessageFault):
    """Commands or joint states arrive later by a delay, s, in order."""

    delay: float = 0.005


@dataclass(frozen=True)
class NotFinite(MessageFault):
    """A field of commands or joint states is NaN, of all joints if `joint` is empty."""

    field: str = "effort"
    joint: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.field not in (("effort",) if self.what == "commands" else ("position", "velocity", "effort")):
            raise SettingsError(f"{self}: expected effort, or position or velocity of joint states")


@dataclass(frozen=True)
class SensorFault(MessageFault):
    """A fault of the joint sensors, of all joints if `joint` is empty."""

    what: str = field(default="states", init=False, repr=False)
    joint: str = ""


@dataclass(frozen=True)
class VelocityNoise(SensorFault):
    """White noise with a standard deviation, rad/s, on the velocities."""

    deviation: float = 0.05


@dataclass(frozen=True)
class StuckEncoder(SensorFault):
    """A position stays at its first value; the velocity is zero then, unless it has a sensor of its own."""

    own_velocity: bool = False


@dataclass(frozen=True)
class TorqueSensor(SensorFault):
    """Measured torques are gain * torque + bias, N m."""

    gain: float = 1.0
    bias: float = 0.0


@dataclass(frozen=True)
class WrongClock(SensorFault):
    """Stamps of joint states are off by a step, s, or frozen if it is zero."""

    step: float = 0.0


@dataclass(frozen=True)
class RivalCommands(Fault):
    """Another node commands a torque, N m, on every joint behind each command."""

    torque: float = 0.0


@dataclass(frozen=True)
class Payload(Fault):
    """A mass, kg, 5 cm in front of the flange that no model includes."""

    mass: float


@dataclass(frozen=True)
class Friction(Fault):
    """A factor on viscous and dry friction of the joints."""

    factor: float


@dataclass(frozen=True)
class UnknownObstacle(Fault):
    """A fixed sphere that the planner does not know: position (3,), m, base frame, radius, m, stiffness, N/m."""

    position: Vector
    radius: float = 0.05
    stiffness: float = 5000.0


@dataclass(frozen=True)
class Push(Fault):
    """A force (3,), N, base frame, on a point (3,), m, of a link, in the frame of the link."""

    link: str
    force: Vector
    point: Vector = (0.0, 0.0, 0.0)


AnyFault = TypeVar("AnyFault", bound=Fault)

_OUT_OF_REACH = np.array([0.0, 0.0, -100.0])
"""Where nothing touches the unknown obstacle, m."""


class FaultyPlant(Plant):
    """A simulated arm whose payload and friction change, and an obstacle that comes and goes."""

    def __init__(
        self,
        scene: Scene,
        friction: tuple[float, float] = FRICTION,
        noise_seed: int | None = None,
        unknown: UnknownObstacle | None = None,
    ) -> None:
        """As `Plant`; `unknown`: the sphere for `place_unknown`, out of reach at first."""
        bodies = []
        if unknown is not None:
            ball = BallSettings(radius=unknown.radius, contact_stiffness=unknown.stiffness, fixed=True)
            (obstacle,) = ball.at(_OUT_OF_REACH)
            bodies = obstacle_bodies(obstacle, len(scene.obstacles), 1.0)
            bodies[0].set("mocap", "true")
        super().__init__(scene, friction, noise_seed, bodies)

    def scale_friction(self, factor: float) -> None:
        """Multiply both joint frictions by a factor, relative to those of the scene."""
        self._friction_scale = factor * self.scene.mismatch.friction_scale
        self._apply_joint_settings()

    def set_payload(self, mass: float) -> None:
        """Set a mass, kg, at the flange, in addition to the scene's payload and at the same place."""
        model = self.model
        body = model.body(self.scene.arm.tip_frame).id
        total = self.scene.mismatch.payload + mass
        if total == model.body_mass[body]:
            return
        model.body_mass[body] = total
        model.body_inertia[body] = PAYLOAD_INERTIA * total
        model.body_ipos[body] = PAYLOAD_CENTER
        # Otherwise MuJoCo would take the centre of mass for the origin of a body that was compiled without a mass.
        model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        mujoco.mj_setConst(model, mujoco.MjData(model))
        soften_fixed(model)

    def place_unknown(self, position: Array | None) -> None:
        """Place the unknown sphere at `position` (3,), m, base frame; None moves it out of reach again."""
        if self.model.nmocap:
            self.data.mocap_pos[0] = _OUT_OF_REACH if position is None else position


class Faults:
    """Injects faults: pass all commands and joint states through it, and call `act` before each step of the plant.

    Nothing happens before `start`. The same faults and seed have the same effects. Times are simulated time.
    """

    def __init__(self, faults: Sequence[Fault], seed: int, plant: FaultyPlant) -> None:
        """Raises `SettingsError` for a joint or link that the arm lacks, and for two unknown obstacles."""
        for fault in faults:
            if isinstance(fault, Push) and fault.link not in plant.arm.link_names:
                raise SettingsError(f"{fault}: expected one of the links {', '.join(plant.arm.link_names)}")
            joint = getattr(fault, "joint", "")
            if joint or isinstance(fault, StuckEncoder):
                _joint_index(plant.arm, joint)
        if sum(isinstance(fault, UnknownObstacle) for fault in faults) > 1:
            raise SettingsError("faults: expected one unknown obstacle at most")
        self._faults = tuple(faults)
        self._plant = plant
        self._start_ns: int | None = None
        self._arm = plant.arm
        self._random = np.random.default_rng((seed, len(faults)))
        self._frozen: dict[Fault, float] = {}
        self._commands: deque[tuple[int, Array]] = deque()
        self._states: deque[tuple[int, JointState]] = deque()
        self._acting: list[Fault] = []

    def start(self, now_ns: int) -> None:
        """Count the times of the faults from now on."""
        self._start_ns = now_ns

    def active(self, kind: type[AnyFault], now_ns: int) -> list[AnyFault]:
        """The faults of a kind that act now."""
        if self._start_ns is None:
            return []
        since_start = (now_ns - self._start_ns) / NANOSECONDS
        return [fault for fault in self._faults if isinstance(fault, kind) and fault.is_active(since_start)]

    def send_command(self, torque: Array, now_ns: int) -> None:
        """Send a command (n,), N m, to the drive; raises `InputError` if the drive refuses it."""
        message = self._spoilt(Message({"effort": torque.copy()}), ("commands",), now_ns)
        try:
            if not message.is_lost:
                _send(self._commands, checked_torque(message.values["effort"], self._arm.n), message.delay, now_ns)
        finally:
            for rival in self.active(RivalCommands, now_ns):
                _send(self._commands, np.full(self._arm.n, rival.torque), 0.0, now_ns)

    def commands(self, now_ns: int) -> list[Array]:
        """The commands that reach the drive now, in order."""
        return _arrivals(self._commands, now_ns)

    def joint_states(self, state: JointState) -> list[JointState]:
        """Send the sensors' reading at the state's stamp; returns the joint states that arrive now, in order."""
        values = {"position": state.q, "velocity": state.v, "effort": state.torque}
        message = Message({name: np.array(value, dtype=float) for name, value in values.items()}, state.stamp_ns)
        self._spoilt(message, ("states", "efforts"), state.stamp_ns)
        if not message.is_lost:
            read = message.values
            effort = read["effort"] if message.has_effort else None
            sent = JointState(message.stamp_ns, read["position"], read["velocity"], effort)
            _send(self._states, sent, message.delay, state.stamp_ns)
        return _arrivals(self._states, state.stamp_ns)

    def lose_obstacles(self, now_ns: int) -> bool:
        """Whether the present observation of the obstacles gets lost on its way to the planner."""
        return self._spoilt(Message({}), ("obstacles",), now_ns).is_lost

    def act(self, now_ns: int) -> None:
        """Let the faults of robot and surroundings act on the plant's next step."""
        acting = [fault for fault in self.active(Fault, now_ns) if not isinstance(fault, MessageFault)]
        if acting == self._acting:
            return
        self._acting, plant = acting, self._plant
        plant.set_payload(sum(fault.mass for fault in acting if isinstance(fault, Payload)))
        plant.scale_friction(math.prod(fault.factor for fault in acting if isinstance(fault, Friction)))
        pushes = [fault for fault in acting if isinstance(fault, Push)]
        plant.set_pushes([(push.link, np.array(push.force), np.array(push.point)) for push in pushes])
        places = [np.array(fault.position) for fault in acting if isinstance(fault, UnknownObstacle)]
        plant.place_unknown(places[0] if places else None)

    def _joints(self, joint: str) -> slice:
        """The named joint as a slice of an array (n,); all joints for an empty name."""
        index = _joint_index(self._arm, joint) if joint else 0
        return slice(index, index + 1) if joint else slice(None)

    def _spoil(self, fault: MessageFault, message: Message) -> None:
        """Change a message in place."""
        values = message.values
        match fault:
            case Lost(what="efforts"):
                message.has_effort = False
            case Lost():
                message.is_lost = True
            case Late():
                message.delay += fault.delay
            case NotFinite():
                values[fault.field][self._joints(fault.joint)] = np.nan
            case VelocityNoise():
                joints, noise = self._joints(fault.joint), self._random.standard_normal(self._arm.n)
                values["velocity"][joints] += fault.deviation * noise[joints]
            case StuckEncoder():
                joint = _joint_index(self._arm, fault.joint)
                values["position"][joint] = self._frozen.setdefault(fault, float(values["position"][joint]))
                if not fault.own_velocity:
                    values["velocity"][joint] = 0.0
            case TorqueSensor():
                torque, joints = values["effort"], self._joints(fault.joint)
                torque[joints] = fault.gain * torque[joints] + fault.bias
            case WrongClock(step=0.0):
                message.stamp_ns = int(self._frozen.setdefault(fault, message.stamp_ns))
            case WrongClock():
                message.stamp_ns += round(fault.step * NANOSECONDS)

    def _spoilt(self, message: Message, carried: Sequence[str], now_ns: int) -> Message:
        for fault in self.active(MessageFault, now_ns):
            is_hit = fault.share == 1.0 or self._random.random() < fault.share
            if fault.what in carried and is_hit and not message.is_lost:
                self._spoil(fault, message)
        return message


def _send(line: deque[tuple[int, Item]], item: Item, delay: float, now_ns: int) -> None:
    # Not before earlier messages, which are still in transit when a delay has just ended.
    earliest_ns = line[-1][0] if line else now_ns
    line.append((max(now_ns + round(delay * NANOSECONDS), earliest_ns), item))


def _arrivals(line: deque[tuple[int, Item]], now_ns: int) -> list[Item]:
    arrived = []
    while line and line[0][0] <= now_ns:
        arrived.append(line.popleft()[1])
    return arrived


class FaultyRobot(SimulatedRobot):
    """A simulated robot whose commands, joint states and observations pass through faults.

    Attributes
    ----------
    faults
        Faults that are injected; None without any, so that they cost nothing.
    """

    def __init__(self, scene: Scene, faults: Sequence[Fault] = (), **options: Any) -> None:
        """Build the robot at the scene's start.

        Parameters
        ----------
        scene
            Scene, with its mismatch.
        faults
            What goes wrong from `start_faults` on.
        options
            Of `SimulatedRobot`; `noise_seed` is the seed of the faults, too.

        Raises
        ------
        SettingsError
            As `SimulatedRobot`, or if the arm cannot have these faults.
        """
        hidden = next((each for each in faults if isinstance(each, UnknownObstacle)), None)
        noise_seed = options.get("noise_seed")
        plant = FaultyPlant(scene, noise_seed=noise_seed, unknown=hidden)
        super().__init__(scene, plant=plant, **options)
        seed = scene.seed if noise_seed is None else noise_seed
        self.faults = Faults(faults, seed, plant) if faults else None

    def start_faults(self) -> None:
        """Count the times of the faults from now on."""
        if self.faults is not None:
            self.faults.start(self.now_ns)

    def command(self, torque: Array, clock_ns: int) -> None:
        """As `SimulatedRobot.command`; with faults, commands travel first."""
        if self.faults is not None:
            self.faults.send_command(torque, self.now_ns)
        else:
            super().command(torque, clock_ns)

    def _tick(self, clock_ns: int) -> None:
        if self.faults is not None:
            for torque in self.faults.commands(self.now_ns):
                super().command(torque, clock_ns)
            self.faults.act(self.now_ns)
        super()._tick(clock_ns)

    def read(self) -> list[JointState]:
        """The joint states that arrive now. Each call draws new sensor noise."""
        (state,) = super().read()
        return [state] if self.faults is None else self.faults.joint_states(state)

    def shows_obstacles(self) -> bool:
        """As `SimulatedRobot.shows_obstacles`, unless an observation gets lost."""
        return super().shows_obstacles() and (self.faults is None or not self.faults.lose_obstacles(self.now_ns))


def _joint_index(arm: Arm, name: str) -> int:
    """Index of a joint; raises `SettingsError` with the names that there are."""
    if name not in arm.joint_names:
        raise SettingsError(f"joint '{name}' is unknown; the arm's joints are {', '.join(arm.joint_names)}")
    return arm.joint_names.index(name)
