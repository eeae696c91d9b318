"""The driver of the simulated iiwa: joint states out, torques in, at 1 kHz or in lockstep.

A real robot's driver replaces this node; topics and watchdog behaviour are described in msg_docs/driver.md.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.clock import Clock as RosClock
from rclpy.clock import ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from contact_reach_ros.errors import ContactReachError, InputError, SettingsError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.messages import nanoseconds, set_time
from contact_reach_ros.nodes.obstacle_markers import ObstacleMarkerWriter
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.rivals import LOOK_AROUND_S, rivalry
from contact_reach_ros.nodes.serialized import JointStateWriter, read_command
from contact_reach_ros.plant.drive import Drive, WatchdogSettings
from contact_reach_ros.plant.fault_kinds import Schedule, Seam
from contact_reach_ros.plant.fault_schedules import parse_faults
from contact_reach_ros.plant.faults import Faults, State
from contact_reach_ros.plant.plant import CONTACT_BODIES, TICK, Plant
from contact_reach_ros.plant.settings import JointSettings, SensorSettings
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.urdf import build_urdf
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.scenes.scene import parse_target
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.timing import Histogram, StampOrder, write_counts
from contact_reach_ros.units import NANOSECONDS

PRIORITY = 80

_TICK_NS = int(TICK * NANOSECONDS)
_MAX_CATCH_UP = 20
_CONTACTS_EVERY = 5
_OBSTACLES_EVERY = 20
_WALLS_EVERY = 40
"""Ticks between obstacle messages; those of walls are large."""
_CLOCK_EVERY = 10
_CONTROLLER = "controller"
_LOCKSTEP_START_NS = 1000 * NANOSECONDS
"""Simulated time begins well after zero, which ROS takes for 'not set'."""
_ANSWER_NS = 500_000
"""How long the controller is waited for. A late tick catches up all the same: it needs less than the other half."""
_REST_NS = 300_000
"""Of a tick, for what is published after the joint state."""
_LOCKSTEP_REPEAT_NS = 20_000_000
_LOCKSTEP_PATIENCE_NS = 30 * NANOSECONDS


@dataclass(frozen=True)
class DriverSettings(Settings):
    """What to simulate, and in which time."""

    scene: str = setting("ball", "scene: a name or the path of a YAML file")
    seed: int = setting(0, "seed of the scene and the sensor noise", minimum=0, maximum=2**31 - 1)
    target: str = setting("", "flange position that the scene is built for, 'x y z' in m; drawn when empty")
    lockstep: bool = setting(False, "advance only when controller, observer and planner are done with the last tick")
    faults: str = setting("", "what goes wrong after activation: a schedule or its YAML file, see docs/faults.md")


class DriverNode(ManagedNode):
    """Simulated robot behind the topics of a real one."""

    NAME = "driver"
    SECTIONS: ClassVar[Sections] = {
        "": DriverSettings,
        "watchdog": WatchdogSettings,
        "sensors": SensorSettings,
        "joints": JointSettings,
    }

    def __init__(self) -> None:
        super().__init__()
        # This node is the clock, and does not use one.
        self.lockstep = self.settings[""].lockstep
        self._write_joint_states = self.make_writer(topics.JOINT_STATES.kept(self.lockstep))
        self._write_contacts = self.make_writer(topics.SIM_CONTACTS)
        self._obstacles = self.make_publisher(topics.OBSTACLES)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._published_safety: tuple[str, str] | None = None
        self._description = self.make_publisher(topics.ROBOT_DESCRIPTION)
        self._clock_publisher = self.make_publisher(topics.CLOCK) if self.lockstep else None
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/stop", self._on_stop)
        qos = topics.EVERY if self.lockstep else topics.NEWEST
        self.inbox.add(topics.COMMANDS, self._on_command, qos, serialized=True)
        self.create_subscription(topics.SIM_FAULTS.type, topics.SIM_FAULTS.name, self._on_faults, topics.SIM_FAULTS.qos)
        self._horizons = {"observer": 0, "planner": 0}
        if self.lockstep:
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._on_horizon, topics.EVERY)
        settings = self.settings
        chosen: DriverSettings = settings[""]
        self._scene = make_scene(read_scene(chosen.scene), chosen.seed, parse_target(chosen.target))
        self._plant = Plant(self._scene, settings["sensors"], settings["joints"], spare_obstacle=True)
        self._drive = Drive(self._plant, settings["watchdog"])
        self._faults = self._make_faults(driver_faults(chosen.faults))
        """None while nothing goes wrong, so that it costs nothing then."""
        self._new_faults: deque[Faults | None] = deque()
        self._obstacles_every = _WALLS_EVERY if self._scene.walls else _OBSTACLES_EVERY
        self._start_ns = 0
        self._next_ns = 0
        self._published_ns = 0
        self._unanswered = 1
        """Joint states that the controller has not answered yet."""
        self._order = StampOrder()
        self._rivalry = ""
        self.create_timer(LOOK_AROUND_S, self._look_around, clock=RosClock(clock_type=ClockType.STEADY_TIME))
        self._horizon_due_ns = 0
        self._round_trip = Histogram()
        self._wake_up_late = Histogram()
        self._missed = 0
        self._stood_ns = 0
        """How long the simulated robot has stood still because this process did."""
        self._peak_contact = np.zeros(len(CONTACT_BODIES))

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Prepare the messages."""
        self._prepare_messages()
        scene = self._scene
        self.get_logger().info(
            f"scene {scene.name}, seed {scene.seed}, {len(scene.balls)} ball(s), {len(scene.walls)} wall(s); "
            f"a goal for it: {np.round(scene.target, 3).tolist()} m"
        )
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to tick."""
        self._description.publish(String(data=build_urdf()))
        self._start_ns = _LOCKSTEP_START_NS if self.lockstep else time.time_ns()
        self._start_ns -= self._plant.steps * _TICK_NS
        self._next_ns = time.monotonic_ns() + _TICK_NS
        if self._faults is not None:
            self._faults.start(self._now_ns)
        return super().on_activate(state)

    def turn(self) -> None:
        """One tick."""
        if self.lockstep:
            self._lockstep_tick()
        else:
            self._realtime_tick()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Tick rates, misses, round trip and watchdog."""
        values: dict[str, Any] = {
            "ticks": self._plant.steps,
            "missed ticks": self._missed,
            "commands rejected": self._drive.rejected,
            "actuation": self._plant.actuation.value,
            "stop reason": self._drive.stop_reason,
            "faults": "none" if self._faults is None else self._faults.text(),
        }
        for name, histogram in (("round trip", self._round_trip), ("wake-up late", self._wake_up_late)):
            values |= {f"{name} {key} us": value for key, value in histogram.summary().items()}
            values[f"{name} counts"] = write_counts(histogram.counts())
        return self._drive.stop_reason or self._rivalry, values

    def _realtime_tick(self) -> None:
        now_ns = time.monotonic_ns()
        was_late = now_ns >= self._next_ns
        if not was_late:
            time.sleep((self._next_ns - now_ns) / NANOSECONDS)
            now_ns = time.monotonic_ns()
        self._wake_up_late.add(now_ns - self._next_ns)
        self._stand_still((now_ns - self._next_ns) // _TICK_NS - _MAX_CATCH_UP)
        if was_late and self._unanswered > 0:
            # On the same CPU the controller, which has less priority, would never get to answer while this is late.
            self.inbox.wait(_ANSWER_NS)
            now_ns = time.monotonic_ns()
        else:
            self.inbox.poll()
        missed = max((now_ns - self._next_ns) // _TICK_NS, 0)
        self._missed += missed
        # The simulated robot moves on as a real one would, whether or not this process was on time.
        for _ in range(1 + missed):
            self._tick(now_ns - self._stood_ns)
        self._next_ns += (1 + missed) * _TICK_NS
        self._publish()

    def _stand_still(self, ticks: int) -> None:
        """After a long pause of this process: its robot has not moved, and hears nobody, but its stamps go on."""
        if ticks > 0:
            self._missed += ticks
            self._start_ns += ticks * _TICK_NS
            self._next_ns += ticks * _TICK_NS
            self._stood_ns += ticks * _TICK_NS

    def _lockstep_tick(self) -> None:
        self._publish()
        due_ns = self._horizon_due_ns
        start_ns = repeat_ns = time.monotonic_ns()
        while not (self._unanswered <= 0 and min(self._horizons.values()) >= due_ns):
            self.inbox.wait(_LOCKSTEP_REPEAT_NS)
            if self._stop.is_set() or not self.running:
                return
            now_ns = time.monotonic_ns()
            if self._plant.steps == 0 and now_ns - repeat_ns > _LOCKSTEP_REPEAT_NS:
                # Nodes that come up late see the first state too.
                repeat_ns, unanswered = now_ns, self._unanswered
                self._publish()
                # Who has answered it does not answer it again.
                self._unanswered = unanswered
            elif self._plant.steps > 0 and now_ns - start_ns > _LOCKSTEP_PATIENCE_NS:
                silent = [name for name, horizon in self._horizons.items() if horizon < due_ns]
                silent += ["controller"] if self._unanswered > 0 else []
                raise ContactReachError(f"lockstep: no answer from {', '.join(silent)} for 30 s; see the node's log")
        self._tick(self._now_ns)

    @property
    def _now_ns(self) -> int:
        """Time of the simulated robot, ns."""
        return self._start_ns + self._plant.steps * _TICK_NS

    def _tick(self, clock_ns: int) -> None:
        if self._new_faults:
            self._begin_faults()
        if self._faults is not None:
            for torque in self._faults.commands(self._now_ns):
                self._command(torque, clock_ns)
            self._faults.act(self._now_ns)
        self._drive.tick(clock_ns)
        np.maximum(self._peak_contact, self._plant.contact_forces(), out=self._peak_contact)

    def _publish(self) -> None:
        now_ns, steps = self._now_ns, self._plant.steps
        reading = self._plant.read()
        if self._faults is None:
            states = [State(now_ns, reading)]
        else:
            self._faults.send_state(reading, now_ns)
            states = self._faults.states(now_ns)
        self._publish_states(states)
        if (self._plant.actuation.value, self._drive.stop_reason) != self._published_safety:
            self._publish_safety()
        contacts = steps % _CONTACTS_EVERY == 0
        obstacles = steps % self._obstacles_every == 0 and bool(self._scene.balls or self._scene.walls)
        if contacts or obstacles:
            self._let_the_controller_answer()
        if contacts:
            self._publish_contacts(now_ns)
        if obstacles:
            self._obstacles.publish(self._obstacle_writer.write(self._plant.obstacle_positions(), now_ns))
        if self._clock_publisher is not None and steps % _CLOCK_EVERY == 0:
            message = Clock()
            set_time(message.clock, now_ns)
            self._clock_publisher.publish(message)

    def _let_the_controller_answer(self) -> None:
        """On the same CPU it would wait for all that is published besides; not where there is no time for that."""
        room_ns = self._next_ns - time.monotonic_ns() - _REST_NS
        if self._unanswered > 0 and room_ns > 0 and not self.lockstep:
            self.inbox.wait(min(room_ns, _ANSWER_NS))

    def _publish_states(self, states: list[State]) -> None:
        # Nobody answers what was not published, or what has to be refused.
        self._unanswered, self._horizon_due_ns = 0, 0
        for state in states:
            stamp_ns, reading = state
            data = self._state_writer.write(stamp_ns, reading.position, reading.velocity, reading.torque)
            if self._faults is None or state.is_finite:
                # The controller answers new ones only, by the same rule.
                self._unanswered += self._order.is_new(stamp_ns)
                self._horizon_due_ns = stamp_ns + _TICK_NS
            self._published_ns = time.time_ns()
            self._write_joint_states(data)

    def _publish_safety(self) -> None:
        actuation, reason = self._plant.actuation.value, self._drive.stop_reason
        self._published_safety = (actuation, reason)
        level = DiagnosticStatus.ERROR if reason else DiagnosticStatus.OK
        message = DiagnosticStatus(level=level, name=self.NAME, message=reason or actuation, hardware_id="iiwa14")
        message.values = [KeyValue(key="actuation", value=actuation)]
        self._safety.publish(message)
        if reason:
            self.say(LoggingSeverity.ERROR, f"brakes closed: {reason}; call ~/reset to go on")

    def _publish_contacts(self, now_ns: int) -> None:
        forces = self._peak_contact.tolist()
        self._write_contacts(self._contact_writer.write(now_ns, [*forces, sum(forces), max(forces)]))
        self._peak_contact[:] = 0.0

    def _prepare_messages(self) -> None:
        """Messages that are filled again each time."""
        base = iiwa14.BASE_NAME
        self._state_writer = JointStateWriter(iiwa14.JOINT_NAMES, base, ["position", "velocity", "effort"])
        self._contact_writer = JointStateWriter([*CONTACT_BODIES, "sum", "max"], base, ["effort"])
        self._obstacle_writer = ObstacleMarkerWriter(self._scene)

    def _on_command(self, data: bytes) -> None:
        if self._unanswered > 0:
            self._round_trip.add(max(self.inbox.received_ns - self._published_ns, 0))
            self._unanswered -= 1
        try:
            if self._rivalry:
                raise InputError(f"{self._rivalry}: no command is taken; end the others")
            torque = read_command(data)
        except InputError as error:
            self.refuse("commands", error)
            return
        if self._faults is not None:
            self._faults.send_command(torque, self._now_ns)
        else:
            self._command(torque, self._now_ns if self.lockstep else time.monotonic_ns() - self._stood_ns)

    def _command(self, torque: np.ndarray, clock_ns: int) -> None:
        try:
            self._drive.command(torque, clock_ns)
        except InputError as error:
            self.refuse("commands", error)

    def _make_faults(self, schedule: Schedule) -> Faults | None:
        return Faults(schedule, self._scene.seed, self._plant) if schedule else None

    def _begin_faults(self) -> None:
        """Put the schedule in force that came last; what the one before has changed is undone."""
        while self._new_faults:
            faults = self._new_faults.popleft()
        if self._faults is not None:
            self._faults.end()
        self._faults = faults
        if faults is not None:
            faults.start(self._now_ns)

    def _on_faults(self, message: String) -> None:
        """A schedule instead of the one at hand; an empty one ends all faults. Called in the services' thread."""
        try:
            faults = self._make_faults(driver_faults(message.data))
        except ContactReachError as error:
            self.refuse("faults", error)
            return
        self.get_logger().warning(f"faults: {message.data.strip() or 'none'}")
        self._new_faults.append(faults)

    def _on_horizon(self, message: Header) -> None:
        if message.frame_id == _CONTROLLER:
            self._unanswered -= 1
        elif message.frame_id in self._horizons:
            self._horizons[message.frame_id] = nanoseconds(message.stamp)

    def _look_around(self) -> None:
        """Two who command the arm in turns are obeyed by no robot; runs beside the loop, a few times a second."""
        self._rivalry = rivalry(self, [topics.COMMANDS])
        if self._rivalry and self._drive.is_open:
            self._drive.stop(self._rivalry)

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._drive.stop("stop service called")
        response.success, response.message = True, "brakes closed"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._drive.reset()
        response.success, response.message = True, "released; the brakes open after steady commands"
        return response


def driver_faults(text: str) -> Schedule:
    """The schedule in a text, as `parse_faults`, of faults that the driver can play.

    Raises
    ------
    SettingsError
        If it is no schedule, or silences a node, which only the node itself or its process can.
    """
    schedule = parse_faults(text)
    for fault in schedule:
        if fault.SEAM is Seam.NODES:
            raise SettingsError(
                f"faults: {fault.KIND} is none of the driver's; freeze or kill the node: "
                "ros2 run contact_reach_ros faults freeze planner"
            )
    return schedule


def main() -> None:
    """Run the driver."""
    sys.exit(run(DriverNode, Role.LOOP, sys.argv, PRIORITY))


if __name__ == "__main__":
    main()
