"""Plays what goes wrong: messages, sensors, robot and other nodes, at their times."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.plant.fault_kinds import (
    ALL_JOINTS,
    ClockJump,
    DelayCommands,
    DelayedFault,
    DelayStates,
    DropCommands,
    DropStates,
    DuplicateCommands,
    DuplicatedFault,
    DuplicateStates,
    ExternalPush,
    Fault,
    Friction,
    LatePlans,
    NanCommands,
    NanStates,
    Obstacle,
    Payload,
    Schedule,
    Seam,
    SharedFault,
    StifferFoam,
    StuckEncoder,
    TorqueSensor,
    VelocityNoise,
)
from contact_reach_ros.plant.plant import Plant, Push, Reading
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]


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
        drops: Sequence[SharedFault],
        delays: Sequence[DelayedFault],
        duplicates: Sequence[DuplicatedFault],
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
    if name == ALL_JOINTS:
        return slice(None)
    joint = iiwa14.joint_index(name)
    return slice(joint, joint + 1)


def _spoilt(values: Array, joint: str) -> Array:
    spoilt = values.copy()
    spoilt[_joints(joint)] = np.nan
    return spoilt


def _product(factors: Iterable[float]) -> float:
    return float(np.prod(list(factors)))
