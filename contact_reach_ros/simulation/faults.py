"""Playback of a schedule of faults in the simulation."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable
from typing import Generic, TypeVar

import numpy as np

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.simulation.fault_kinds import (
    OBSTACLE,
    PAUSE,
    Context,
    Fault,
    Message,
    Schedule,
    Seam,
    Surroundings,
    fault_kinds,
)
from contact_reach_ros.simulation.plant import Plant
from contact_reach_ros.units import NANOSECONDS

_OF_STATES = (Seam.SENSORS, Seam.STATES, Seam.CLOCK)


Item = TypeVar("Item")


class _Line(Generic[Item]):
    """Messages in transit from one node to another."""

    def __init__(self) -> None:
        self._under_way: list[tuple[int, int, Item]] = []
        self._order = itertools.count()
        self._last_due_ns = 0

    def send(self, item: Item, message: Message, now_ns: int) -> None:
        # Not before earlier messages, which are still in transit when a delay has just ended.
        self._last_due_ns = due_ns = max(now_ns + round(message.delay * NANOSECONDS), self._last_due_ns)
        for after in (0.0, *message.copies):
            heapq.heappush(self._under_way, (due_ns + round(after * NANOSECONDS), next(self._order), item))

    def arrivals(self, now_ns: int) -> list[Item]:
        arrived = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            arrived.append(heapq.heappop(self._under_way)[2])
        return arrived


class Faults:
    """Plays a schedule: pass it all commands and joint states, and call `act` before each step of the plant.

    Nothing happens before `start`. The same schedule and seed give the same faults. Times are simulated time.
    """

    def __init__(self, schedule: Schedule, seed: int, plant: Plant) -> None:
        """`plant` needs a spare obstacle if the schedule has an obstacle.

        Raises `SettingsError` if two obstacles would be present at the same time, or there is no spare one.
        """
        self.schedule = schedule
        self._plant = plant
        self._start_ns: int | None = None
        self._context = Context(plant.arm, np.random.default_rng((seed, len(schedule))))
        self._commands, self._states = _Line[Array](), _Line[JointState]()
        order = list(fault_kinds(plant.arm))
        ordered = sorted(schedule, key=lambda fault: order.index(fault.name))
        self._on_commands = [fault for fault in ordered if fault.kind.seam is Seam.COMMANDS]
        self._on_states = [fault for fault in ordered if fault.kind.seam in _OF_STATES]
        self._on_obstacles = [fault for fault in ordered if fault.kind.seam is Seam.OBSTACLES]
        self._on_plant = [fault for fault in ordered if fault.kind.seam is Seam.PLANT]
        self._on_driver = [fault for fault in ordered if fault.name == PAUSE]
        self._on_nodes = [fault for fault in ordered if fault.kind.seam is Seam.NODES]
        self._acting: list[Fault] = []
        obstacles = sorted((fault for fault in schedule if fault.name == OBSTACLE), key=lambda fault: fault["at"])
        for first, second in itertools.pairwise(obstacles):
            if first.is_active(second["at"]):
                raise SettingsError("faults: two obstacles at the same time; there is one: end the first with `for`")
        if obstacles and not plant.has_spare_obstacle:
            raise SettingsError("faults: obstacle: the simulation was built without one to spare")

    def start(self, now_ns: int) -> None:
        """Begin: the times of the schedule count from now."""
        self._start_ns = now_ns

    def act(self, now_ns: int) -> None:
        """Let the faults of robot and surroundings act on the plant's next step."""
        if self._on_plant:
            self._change(self._active(self._on_plant, now_ns))

    def end(self) -> None:
        """Undo the changes to robot and surroundings; messages in transit are lost."""
        self._change([])

    def text(self) -> str:
        """The schedule as text for `parse_faults`."""
        return "; ".join(fault.text() for fault in self.schedule)

    def send_command(self, torque: Array, now_ns: int) -> None:
        """Send a command (n,), N m, to the drive."""
        message = Message({"effort": torque.copy()})
        self._spoil(message, self._on_commands, now_ns)
        for each in (message, *message.rivals):
            if not each.is_lost:
                self._commands.send(each.values["effort"], each, now_ns)

    def commands(self, now_ns: int) -> list[Array]:
        """The commands that reach the drive now, in order."""
        return self._commands.arrivals(now_ns)

    def send_state(self, state: JointState) -> None:
        """Send the sensors' reading at the state's stamp to controller, observer and planner."""
        values = {"position": state.q, "velocity": state.v, "effort": state.torque}
        message = Message({name: np.array(value, dtype=float) for name, value in values.items()}, state.stamp_ns)
        self._spoil(message, self._on_states, state.stamp_ns)
        for each in (message, *message.rivals):
            if not each.is_lost:
                sent = JointState(
                    each.stamp_ns, each.values["position"], each.values["velocity"], each.values.get("effort")
                )
                self._states.send(sent, each, state.stamp_ns)

    def states(self, now_ns: int) -> list[JointState]:
        """The joint states that arrive now, in order."""
        # A duplicate is another object, like a message that comes twice: the controller tells states by identity.
        return [JointState(*state) for state in self._states.arrivals(now_ns)]

    def lose_obstacles(self, now_ns: int) -> bool:
        """Whether the obstacles that are seen now get lost on their way to the planner."""
        message = Message({})
        self._spoil(message, self._on_obstacles, now_ns)
        return message.is_lost

    def paused(self, now_ns: int) -> bool:
        """Whether the driver pauses."""
        return bool(self._active(self._on_driver, now_ns))

    def of_nodes(self, kind: str, now_ns: int) -> list[Fault]:
        """The active faults of a kind that acts on nodes, such as 'planner_silent'."""
        return [fault for fault in self._active(self._on_nodes, now_ns) if fault.name == kind]

    def _active(self, faults: Iterable[Fault], now_ns: int) -> list[Fault]:
        if self._start_ns is None:
            return []
        since_start = (now_ns - self._start_ns) / NANOSECONDS
        return [fault for fault in faults if fault.is_active(since_start)]

    def _spoil(self, message: Message, faults: Iterable[Fault], now_ns: int) -> None:
        for fault in self._active(faults, now_ns):
            is_hit = "share" not in fault.values or self._context.random.random() < fault["share"]
            if is_hit:
                fault.kind.act(fault, message, self._context)
            if message.is_lost:
                return

    def _change(self, acting: list[Fault]) -> None:
        """Let these faults, and no others, act on robot and surroundings."""
        if acting == self._acting:
            return
        self._acting = acting
        changes = Surroundings()
        for fault in acting:
            fault.kind.act(fault, changes, self._context)
        plant = self._plant
        plant.set_payload(changes.payload)
        plant.scale_friction(changes.friction)
        plant.scale_foam(changes.foam)
        plant.set_pushes(changes.pushes)
        if changes.obstacle is not None:
            plant.place_spare_obstacle(*changes.obstacle)
        elif plant.has_spare_obstacle:
            plant.remove_spare_obstacle()
