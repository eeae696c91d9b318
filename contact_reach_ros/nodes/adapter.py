"""The adapter between controller and drive: passes commands on, and watches them for a drive that does not."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.logging import LoggingSeverity
from std_msgs.msg import Header

from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.control.adapter_settings import ADAPTER_SECTIONS, FRANKA, LBR, AdapterSettings
from contact_reach_ros.control.command_guard import CommandGuard, Phase
from contact_reach_ros.control.supervisor import check_state
from contact_reach_ros.drives.effort import EffortTarget
from contact_reach_ros.drives.franka import FrankaTarget
from contact_reach_ros.drives.lbr import LbrTarget
from contact_reach_ros.errors import InputError, StopCode, StopReason, internal, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.diagnostics import to_stop_state
from contact_reach_ros.messages.serialized import JointStateReader, JointStateWriter, read_command
from contact_reach_ros.messages.values import read_settings
from contact_reach_ros.ros.graph import LOOK_AROUND_S, rivalry
from contact_reach_ros.ros.lockstep import BEHIND_ADAPTER, CONTROLLER
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.ros.scheduling import ADAPTER_PRIORITY, Role
from contact_reach_ros.timing import Histogram, StampOrder

NAME = "adapter"

_GRAVITY = "gravity_compensation"
_IDLE_NS = 100_000_000
_SLEW_S, _REST_S = 0.1, 1.0
"""Shortest and longest time to bring the arm to rest before the node ends; torques change within the shortest."""


class AdapterNode(ManagedNode):
    """Passes the controller's commands to the drive through a guard."""

    NAME = NAME
    SECTIONS = ADAPTER_SECTIONS

    def __init__(self) -> None:
        super().__init__()
        self._target = self._make_target(self.settings[""])
        self._write = self.make_writer(self._target.topic.kept(self.lockstep))
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._published: tuple[Phase, str] | None = None
        # It answers the driver in the controller's name.
        self._lockstep = self.make_lockstep(CONTROLLER)
        qos = self._lockstep.qos
        if isinstance(self._target, LbrTarget):
            self._write_state = self.make_writer(topics.JOINT_STATES.kept(self.lockstep))
            self._state_writer = JointStateWriter(
                self.arm.joint_names, self.arm.base_frame, ["position", "velocity", "effort"]
            )
            self._target.listen(self.inbox, self._forward)
        else:
            # Commands come at the same rate: a state need not wake the loop up, except where it has to be awaited.
            self.inbox.add(topics.JOINT_STATES, self._on_state, qos, serialized=True, hurried=self.lockstep)
        self.inbox.add(topics.ADAPTER_COMMANDS, self._on_command, qos, serialized=True)
        if self._lockstep.active:
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._on_horizon, topics.EVERY)
        self.inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS)
        self.offer("~/stop", self._answer_stop)
        self.offer("~/reset", self._answer_reset)
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._guard = self._make_guard()
        self._disagreements: dict[str, str] = {}
        """By node, how its settings differ from what the adapter or its drive needs; empty where they do not."""
        self._rivalry = ""
        self._passed = self._harmless = 0
        self._delay = Histogram()
        """From the arrival of a command to its publication."""
        self._order = StampOrder()
        self._state_ns = 0
        """Stamp of the last joint state."""
        self._states = self._unanswered = 0
        """Joint states that were new, and those of them that the controller has not answered, in lockstep."""
        self._answers: deque[bytes | None] = deque()
        """Commands of the controller, None where it answered without one, whose joint state is still to come."""
        self.every(LOOK_AROUND_S, self._look_around)

    def configure(self) -> None:
        """Warm up all computations."""
        self._make_guard().rehearse()

    def activate(self) -> None:
        """Wait for the first command."""
        self._look_around()
        self._publish_safety()

    def deactivate(self) -> None:
        """Bring the arm to rest first: nobody would stop it afterwards."""
        self.inbox.call(self._come_to_rest)

    def close(self) -> None:
        """Bring the arm to rest."""
        if self.running:
            self._come_to_rest()

    def on_fault(self, what: str, error: Exception) -> None:
        """Stop the arm: after a fault of its program nobody knows what would be passed on."""
        if not self._guard.stop_reason:
            reason = internal(what, error)
            self.inbox.post(lambda: self._stop_for(reason))

    def turn(self) -> None:
        """Handle what has arrived, then look for silence."""
        if self.lockstep:
            self.inbox.wait(_IDLE_NS)
            return
        self.inbox.wait(self._guard.due_ns(time.monotonic_ns(), _IDLE_NS))
        self._look_for_silence()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """State, counts, and the delay of commands."""
        values = {
            "state": self._guard.phase.value,
            "commands passed on": self._passed,
            "harmless torques": self._harmless,
            "joints": ", ".join(self._target.order),
            **self._target.diagnosis(),
            **{f"delay {key} us": value for key, value in self._delay.summary().items()},
        }
        return self._guard.stop_reason or self._problem(), values

    def _problem(self) -> str:
        """Why no command may be passed on; empty if it may."""
        return self._rivalry or self._target.problem or next(filter(None, self._disagreements.values()), "")

    def _make_target(self, chosen: AdapterSettings) -> EffortTarget | LbrTarget | FrankaTarget:
        settings: Any = self.settings[chosen.kind]
        if chosen.kind == LBR:
            return LbrTarget(self, self.arm, settings, self.period, self.lockstep)
        if chosen.kind == FRANKA:
            return FrankaTarget(self, self.arm, settings)
        return EffortTarget(self, self.arm, settings, chosen.gravity_compensation)

    def _make_guard(self) -> CommandGuard:
        return CommandGuard(self.arm, self.settings[""], self.period)

    def _clock_ns(self) -> int:
        """Time of the watchdog's clock: steady, or simulated in lockstep."""
        return self._state_ns if self.lockstep else time.monotonic_ns()

    def _forward(self, state: JointState) -> None:
        """Publish a joint state that the drive's messages contain, and take it."""
        assert state.torque is not None
        self._write_state(self._state_writer.write(state.stamp_ns, state.q, state.v, state.torque))
        self._take(state)

    def _on_state(self, data: bytes) -> None:
        self._take(self._reader.read(data))

    def _take(self, state: JointState) -> None:
        check_state(self.arm, state.q, state.v)
        if self._order.is_new(state.stamp_ns):
            self._state_ns = state.stamp_ns
            self._guard.see(state, self._clock_ns())
            self._states += 1
            # The first state is repeated until all nodes are there, and may be answered several times.
            self._unanswered = self._unanswered + 1 if self._states > 2 else 1
        self._settle()

    def _on_command(self, data: bytes) -> None:
        if self.lockstep:
            self._answers.append(data)
            self._settle()
        else:
            self._pass_on(data)
            self._delay.add(time.monotonic_ns() - self.inbox.handled_ns)

    def _on_horizon(self, message: Header) -> None:
        if message.frame_id == BEHIND_ADAPTER:
            self._answers.append(None)
            self._settle()

    def _settle(self) -> None:
        """In lockstep, answer the driver once for each answer of the controller, when its joint state has come, too."""
        while self._answers and self._unanswered > 0:
            self._unanswered -= self._states > 1
            command = self._answers.popleft()
            sent = self._passed + self._harmless
            if command is not None:
                try:
                    self._pass_on(command)
                except InputError as error:
                    self.refuse(topics.ADAPTER_COMMANDS.contents, error)
            self._look_for_silence()
            if self._passed + self._harmless == sent:
                self._lockstep.answer(self._state_ns)

    def _pass_on(self, data: bytes) -> None:
        if problem := self._problem():
            raise InputError(f"{problem}: nothing is passed on")
        torque = self._guard.command(read_command(data), self._clock_ns())
        if torque is not None:
            # The controller hears that its commands are in force before it sees their effect.
            self._publish_safety()
            self._write(self._target.write(torque))
            self._passed += 1

    def _look_for_silence(self) -> None:
        if self._target.problem and self._guard.phase is Phase.PASSING:
            self._guard.stop(StopReason(StopCode.DRIVE, self._target.problem))
            self._target.stop()
        was_stopped = self._guard.stop_reason
        torque = self._guard.watch(self._clock_ns())
        if torque is not None:
            self._write(self._target.write(torque))
            self._harmless += 1
        if self._guard.stop_reason and not was_stopped:
            self._target.stop()
        self._publish_safety()

    def _publish_safety(self) -> None:
        """Publish the state if it has changed."""
        phase, reason = self._guard.phase, self._guard.stop_reason
        if (phase, reason) == self._published:
            return
        self._published = (phase, reason)
        self._safety.publish(to_stop_state(NAME, self.arm, reason, phase.value, {"state": phase.value}))
        if reason:
            self.say(LoggingSeverity.ERROR, f"no command is passed on: {reason}; call ~/reset to continue")

    def _on_settings(self, message: DiagnosticStatus) -> None:
        values, differs = read_settings(message), ""
        if message.name == CONTROLLER:
            own, name = self.settings[""].gravity_compensation, f"supervision.{_GRAVITY}"
            controllers = values.get(name, own)
            differs = f"{_GRAVITY} = {own}, and {name} = {controllers} in the controller" if controllers != own else ""
        self._disagreements[message.name] = differs or self._target.hear(message.name, values)

    def _look_around(self) -> None:
        """Check that nobody else commands the controller or this node, and ask for the order; runs beside the loop."""
        self._target.look()
        self._rivalry = rivalry(self, (topics.JOINT_STATES, self._target.topic, topics.ADAPTER_COMMANDS))
        if self._rivalry and self._guard.phase is not Phase.WAITING and not self._guard.stop_reason:
            reason = StopReason(StopCode.RIVAL, self._rivalry)
            self.inbox.post(lambda: self._stop_for(reason))

    def _answer_stop(self) -> str:
        self.inbox.post(lambda: self._stop_for(requested("stop service called")))
        return "no command is passed on"

    def _stop_for(self, reason: str) -> None:
        if not self._guard.stop_reason:
            self._target.stop()
        self._guard.stop(reason)
        self._publish_safety()

    def _answer_reset(self) -> str:
        # In the loop's thread, because it might be in the middle of a command.
        self.inbox.call(self._reset)
        return "the next command is passed on"

    def _reset(self) -> None:
        if self._rivalry:
            raise InputError(f"{self._rivalry}: end the others first")
        was_stopped = self._guard.stop_reason
        self._guard.reset(self._clock_ns())
        if was_stopped:
            self._target.resume()
        self._publish_safety()

    def _come_to_rest(self) -> None:
        """Stop, and send harmless torques until the arm is at rest; in lockstep, where no time passes for that, one."""
        if self._guard.phase is Phase.WAITING:
            return
        self._stop_for(requested("the adapter is deactivated"))
        began = time.monotonic()
        self._look_for_silence()
        while not self.lockstep and time.monotonic() - began < (_SLEW_S if self._guard.rests else _REST_S):
            time.sleep(self.period)
            self.inbox.poll()
            self._look_for_silence()


def main() -> None:
    """Run the adapter."""
    sys.exit(run(AdapterNode, Role.LOOP, sys.argv, ADAPTER_PRIORITY))


if __name__ == "__main__":
    main()
