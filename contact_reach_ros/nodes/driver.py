"""The driver of the simulated arm: joint states out, torques in, at 1 kHz or in lockstep.

A real robot's driver replaces this node; msg_docs/driver.md describes topics and watchdog.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rosgraph_msgs.msg import Clock

from contact_reach_ros.arm import Array, JointState
from contact_reach_ros.errors import InputError, StopCode, StopReason, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_stop_state, to_time
from contact_reach_ros.messages.obstacle_markers import ObstacleMarkerWriter
from contact_reach_ros.messages.serialized import joint_state_writer, read_command
from contact_reach_ros.ros.lockstep import LockstepDriver
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.scenes.generate import make_scene, parse_target
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import DRIVER_SECTIONS, DriverSettings
from contact_reach_ros.timing import NANOSECONDS, Durations, Pace
from contact_reach_ros.world.scene_file import read_scene

_CONTACTS_EVERY = 5
_CLOCK_EVERY = 10
_LOCKSTEP_START_NS = 1000 * NANOSECONDS
"""Simulated time begins well after zero, which ROS interprets as 'not set'."""
_ANSWER_NS = 500_000
"""Time to wait for the controller. A late tick can still catch up, since it needs less than the other half."""
_REST_NS = 300_000
"""Part of a tick reserved for publishing after the joint state."""


class DriverNode(ManagedNode):
    """Serves the simulated robot behind the topics of a real one."""

    NAME = "driver"
    SECTIONS = DRIVER_SECTIONS
    COMMANDS = topics.COMMANDS
    """Where torques come from."""
    STATES = topics.JOINT_STATES
    """Where `publish_state` publishes."""

    def __init__(self) -> None:
        super().__init__()
        chosen: DriverSettings = self.settings[""]
        self._period_ns = round(self.period * NANOSECONDS)
        participants = lambda: self.count_publishers(topics.LOCKSTEP_HORIZON.name)  # noqa: E731
        is_ending = lambda: self._stop.is_set() or not self.running  # noqa: E731
        self._lockstep = LockstepDriver(self._period_ns, participants, self.inbox.wait, is_ending)
        self._waits_for_goal = chosen.waits_for_goal
        self._waits_for_command = False
        """Whether no command has come since the last joint state."""
        self._write_contacts = self.make_writer(topics.SIM_CONTACTS)
        self._obstacles = self.make_publisher(topics.OBSTACLES)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._published_safety: tuple[str, str] | None = None
        self._clock_publisher = self.make_publisher(topics.CLOCK) if self.lockstep else None
        self.offer("~/reset", self._answer_reset)
        self.offer("~/stop", self._answer_stop)
        self.inbox.add(self.COMMANDS, self._on_command, self.stream_qos, serialized=True)
        # Last: nodes that hear it hear everything else.
        self.write_state = self.make_writer(self.STATES)
        if self.lockstep:
            self.inbox.add(topics.GOAL_STATE, self._on_goal_state)
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._lockstep.hear)
        self._scene = make_scene(read_scene(chosen.scene), self.arm, chosen.seed, parse_target(chosen.target))
        own = self.settings
        self.robot = SimulatedRobot(self._scene, watchdog=own["watchdog"], period=self.period)
        self.pace = Pace(self._period_ns)
        self._published_ns = 0
        self.exclude([self.COMMANDS])
        self._round_trip = Durations()
        self._wake_up_late = Durations()
        self._peak_contact = np.zeros(len(self.arm.contact_links))
        names, base = self.arm.joint_names, self.arm.base_frame
        self._state_writer = joint_state_writer(names, base, ["position", "velocity", "effort"])
        self._contact_writer = joint_state_writer([*self.arm.contact_links, "sum", "max"], base, ["effort"])
        self._obstacle_writer = ObstacleMarkerWriter(self._scene)

    def configure(self) -> None:
        """Log the scene."""
        scene = self._scene
        names = [obstacle.name for obstacle in scene.obstacles] + [f"the {body.name}" for body in scene.environment]
        obstacles = ", ".join(names) or "no obstacles"
        self.get_logger().info(
            f"scene {scene.name}, seed {scene.seed}, {obstacles}; a goal for it: {np.round(scene.target, 3).tolist()} m"
        )

    def activate(self) -> None:
        """Start ticking."""
        start_ns = _LOCKSTEP_START_NS if self.lockstep else time.time_ns()
        self.robot.start_ns += start_ns - self.robot.now_ns
        self.pace.start(time.monotonic_ns())

    def turn(self) -> None:
        """Run one tick."""
        self._lockstep_tick() if self.lockstep else self._realtime_tick()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Tick rates, misses, round trip and watchdog."""
        values: dict[str, Any] = {
            "ticks": self.robot.plant.steps,
            "missed ticks": self.pace.missed,
            "actuation": self.robot.plant.actuation.value,
            "stop reason": self.robot.stop_reason,
        }
        for name, durations in (("round trip", self._round_trip), ("wake-up late", self._wake_up_late)):
            values |= {f"{name} {key} us": value for key, value in durations.summary().items()}
        return self.robot.stop_reason or self.rivals, values

    def _realtime_tick(self) -> None:
        now_ns, due_ns = time.monotonic_ns(), self.pace.next_ns
        was_late = now_ns >= due_ns
        if not was_late:
            time.sleep((due_ns - now_ns) / NANOSECONDS)
            now_ns = time.monotonic_ns()
        self._wake_up_late.add(now_ns - due_ns)
        self.robot.start_ns += self.pace.stand_still(now_ns)
        if was_late and self._waits_for_command:
            # While this is late, the controller on the same CPU, with less priority, would never get to answer.
            self.inbox.wait(_ANSWER_NS)
            now_ns = time.monotonic_ns()
        else:
            self.inbox.poll()
        for _ in range(self.pace.due(now_ns)):
            self._tick(now_ns - self.pace.stood_ns)
        self._publish(self.robot.read(), self.robot.shows_obstacles())

    def _lockstep_tick(self) -> None:
        if self.robot.plant.steps == 0:
            self._lockstep.begin()
        if self._waits_for_goal and self.robot.is_open:
            # All are done with the state before: whenever the goal comes, the first plan is from the next one.
            self._publish_safety()
            self._lockstep.stand_still(lambda: self._waits_for_goal)
        self._publish(self.robot.read(), self.robot.shows_obstacles())
        self._lockstep.wait(self.robot.now_ns)
        # Commands that came before the last promise, but after they were looked for.
        self.inbox.poll()
        self._tick(self.robot.now_ns)

    def _on_goal_state(self, _: DiagnosticStatus) -> None:
        # Also of a goal that was refused: time goes on.
        self._waits_for_goal = False

    def _tick(self, clock_ns: int) -> None:
        self.robot.step(clock_ns)
        np.maximum(self._peak_contact, self.robot.plant.contact_forces(), out=self._peak_contact)

    def _publish(self, states: list[JointState], shows_obstacles: bool) -> None:
        """Publish states, and obstacles where sensors show them, even if there are none: nobody else knows that."""
        robot = self.robot
        now_ns, steps = robot.now_ns, robot.plant.steps
        if not self.lockstep:
            self._publish_states(states)
        if (robot.plant.actuation.value, robot.stop_reason) != self._published_safety:
            self._publish_safety()
        contacts = steps % _CONTACTS_EVERY == 0
        if contacts or shows_obstacles:
            self._yield_to_controller()
        if contacts:
            forces = self._peak_contact.tolist()
            self._write_contacts(self._contact_writer.write([*forces, sum(forces), max(forces)], stamp_ns=now_ns))
            self._peak_contact[:] = 0.0
        if shows_obstacles:
            self._obstacles.publish(self._obstacle_writer.write(robot.plant.obstacle_positions(), now_ns))
        if self.lockstep:
            # Last: nodes that handle it have everything else.
            self._publish_states(states)
        if self._clock_publisher is not None and steps % _CLOCK_EVERY == 0:
            self._clock_publisher.publish(Clock(clock=to_time(now_ns)))

    def _yield_to_controller(self) -> None:
        """If there is time, let the controller, which may share the CPU, answer before anything else is published."""
        room_ns = self.pace.next_ns - time.monotonic_ns() - _REST_NS
        if self._waits_for_command and room_ns > 0 and not self.lockstep:
            self.inbox.wait(min(room_ns, _ANSWER_NS))

    def _publish_states(self, states: list[JointState]) -> None:
        for state in states:
            self._waits_for_command = True
            self._published_ns = time.time_ns()
            self.publish_state(state)

    def publish_state(self, state: JointState) -> None:
        """Publish what the sensors show."""
        assert state.torque is not None
        self.write_state(self._state_writer.write(state.q, state.v, state.torque, stamp_ns=state.stamp_ns))

    def _publish_safety(self) -> None:
        actuation, reason = self.robot.plant.actuation.value, self.robot.stop_reason
        self._published_safety = (actuation, reason)
        self._safety.publish(to_stop_state(self.NAME, self.arm, reason, actuation, {"actuation": actuation}))
        if reason:
            self.say(f"brakes closed: {reason}; call ~/reset to continue")

    def _on_command(self, data: bytes) -> None:
        if self._waits_for_command:
            self._waits_for_command = False
            self._round_trip.add(max(self.inbox.received_ns - self._published_ns, 0))
        if self.rivals:
            raise InputError(f"{self.rivals}: no command is taken; end the others")
        clock_ns = self.robot.now_ns if self.lockstep else time.monotonic_ns() - self.pace.stood_ns
        self.robot.command(self.read_torque(data), clock_ns)

    def read_torque(self, data: bytes) -> Array:
        """The torque (n,), N m, in a message on `COMMANDS`."""
        return read_command(data)

    def on_rivals(self) -> None:
        """Close the brakes: with two publishers of commands no robot would move."""
        if self.robot.is_open:
            self.robot.stop(StopReason(StopCode.RIVAL, self.rivals))

    def _answer_stop(self) -> str:
        self.robot.stop(requested("stop service called"))
        return "brakes closed"

    def _answer_reset(self) -> str:
        self.robot.reset()
        return "released; the brakes open after steady commands"


if __name__ == "__main__":
    sys.exit(run(DriverNode, sys.argv))
