"""The adapter between controller and drive: passes commands on, and watches them for a drive that does not."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from contact_reach_ros.arm import JointState
from contact_reach_ros.control.supervisor import check_state
from contact_reach_ros.drives.command_guard import CommandGuard, Phase
from contact_reach_ros.drives.effort import EffortTarget
from contact_reach_ros.drives.franka import FrankaTarget
from contact_reach_ros.drives.lbr import LbrTarget
from contact_reach_ros.drives.settings import ADAPTER_SECTIONS, FRANKA, LBR, AdapterSettings
from contact_reach_ros.errors import InputError, StopCode, StopReason, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_stop_state
from contact_reach_ros.messages.safety_state import STOPS_CALLED
from contact_reach_ros.messages.serialized import JointStateReader, joint_state_writer, read_command
from contact_reach_ros.messages.values import read_settings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.ros.interfaces import CONTROLLER, OBSERVER
from contact_reach_ros.ros.managed_node import StoppableNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import Durations, StampOrder

_GRAVITY = "gravity_compensation"
_IDLE_NS = 100_000_000
_SLEW_S, _REST_S = 0.1, 1.0
"""Shortest and longest time to bring the arm to rest before the node ends; torques change within the shortest."""
_GONE_S = 1.0
"""Without joint states, and without anybody who hears the torques, for this long: the drive's driver has ended."""
_ENDING = "the adapter is asked to end"


class AdapterNode(StoppableNode):
    """Passes the controller's commands to the drive through a guard."""

    NAME = "adapter"
    SECTIONS = ADAPTER_SECTIONS
    STOPPED = "no command is passed on"
    RELEASED = "the next command is passed on"

    def __init__(self) -> None:
        super().__init__()
        self._target = self._make_target(self.settings[""])
        self._write = self.make_writer(self._target.topic)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._published: tuple[Phase, str, int] | None = None
        if isinstance(self._target, LbrTarget):
            self._write_state = self.make_writer(topics.JOINT_STATES)
            self._state_writer = joint_state_writer(
                self.arm.joint_names, self.arm.base_frame, ["position", "velocity", "effort"]
            )
            self._target.listen(self.inbox, self._forward, self.stream_qos)
        self.inbox.add(topics.ADAPTER_COMMANDS, self._on_command, self.stream_qos, serialized=True)
        self.inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS)
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._guard = self._make_guard()
        self._disagreements: dict[str, str] = {}
        """By node, how its settings differ from what the adapter or its drive needs; empty where they do not."""
        self._passed = self._harmless = 0
        self._delay = Durations()
        """From the arrival of a command to its publication."""
        self._order = StampOrder()
        self._is_ending = self._has_told = False
        self._states = 0
        self._last_sign = (0, 0.0)
        """The number of states when the drive last gave a sign of life, and when that was, s."""
        self.exclude([topics.JOINT_STATES, self._target.topic, topics.ADAPTER_COMMANDS])
        # Commands come at the same rate: a state need not wake the loop up.
        self.follow(topics.JOINT_STATES, self._on_state, hurried=False)

    def configure(self) -> None:
        """Warm up all computations."""
        self._make_guard().rehearse()

    def activate(self) -> None:
        """Wait for the first command."""
        self.look_around()
        self._publish_safety()

    def deactivate(self) -> None:
        """Bring the arm to rest first: nobody would stop it afterwards."""
        self.inbox.call(self._come_to_rest)

    def may_end(self, insists: bool) -> bool:
        """Whether the arm no longer depends on the torques; from the first call on no command is passed on.

        It does not once the drive reports that they do not reach it, or its driver has ended. Otherwise the drive would
        keep the last ones: the node goes on, and says so, until the user insists.
        """
        if not self._is_ending:
            self._is_ending = True
            if self.is_engaged:
                self.stop_once(requested(_ENDING))
            return False
        if not (self.running and self.is_engaged):
            return True
        reason = self._target.idle or self._driver_gone() or ("the user insists" if insists else "")
        if reason:
            self.get_logger().info(f"lets go of the arm: {reason}")
        elif not self._has_told:
            self._has_told = True
            self.get_logger().warning(
                "asked to end, but the drive would keep the last torque: this goes on damping and holding the arm, "
                "until the drive takes no torques or its driver ends. With the arm secured, end it by Ctrl-C once "
                f"more, or kill -INT {os.getpid()}"
            )
        return bool(reason)

    def _driver_gone(self) -> str:
        now, heard = time.monotonic(), self.count_subscribers(self.resolve_topic_name(self._target.topic.name))
        if heard or self._states != self._last_sign[0]:
            self._last_sign = (self._states, now)
        return "the drive's driver has ended" if now - self._last_sign[1] > _GONE_S else ""

    @property
    def stop_reason(self) -> str:
        """Why no command is passed on; empty if they are."""
        return self._guard.stop_reason

    @property
    def is_engaged(self) -> bool:
        """Whether a command was passed on."""
        return self._guard.phase is not Phase.WAITING

    def stop_for(self, reason: str) -> None:
        """Pass nothing on, and stop the drive."""
        if not self._guard.stop_reason:
            self._target.stop()
        self._guard.stop(reason)
        self._publish_safety()

    def reset(self) -> None:
        """Pass commands on again. Raises `InputError` if the arm may not be released yet."""
        if self._is_ending:
            raise InputError(f"{_ENDING}: let it, and start the stack again")
        self._target.check_reset()
        was_stopped = bool(self._guard.stop_reason)
        self._guard.reset(self.now_ns)
        self._target.resume(was_stopped)
        self._publish_safety()

    def turn(self) -> None:
        """Handle what has arrived, then look for silence."""
        self.inbox.wait(self._guard.due_ns(self.now_ns, _IDLE_NS))
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
        ending = _ENDING if self._is_ending else ""
        return ending or self.rivals or self._target.problem or next(filter(None, self._disagreements.values()), "")

    def _make_target(self, chosen: AdapterSettings) -> EffortTarget | LbrTarget | FrankaTarget:
        settings: Any = self.settings[chosen.kind]
        if chosen.kind == LBR:
            return LbrTarget(self, self.arm, settings, self.period)
        if chosen.kind == FRANKA:
            return FrankaTarget(self, self.arm, settings)
        return EffortTarget(self, self.arm, settings, chosen.gravity_compensation)

    def _make_guard(self) -> CommandGuard:
        observer: Any = settings_of(self.ARGUMENTS, OBSERVER, OBSERVER_SECTIONS, self.arm)[""]
        hold = load_budget(observer.contact_budget).resolve(self.arm).handover_thresholds
        return CommandGuard(self.arm, self.settings[""], self.period, hold)

    def _forward(self, state: JointState) -> None:
        """Publish a joint state that the drive's messages contain."""
        assert state.torque is not None
        self._write_state(self._state_writer.write(state.q, state.v, state.torque, stamp_ns=state.stamp_ns))

    def _on_state(self, data: bytes) -> None:
        self._states += 1
        state = self._reader.read(data)
        check_state(self.arm, state.q, state.v)
        if self._order.is_new(state.stamp_ns):
            self._guard.see(state, self.now_ns)
            self._look_for_silence()

    def _on_command(self, data: bytes) -> None:
        if problem := self._problem():
            if problem == self._target.problem and self._target.prepare():
                self._guard.hold()
            raise InputError(f"{problem}: nothing is passed on")
        torque = self._guard.command(read_command(data), self.now_ns)
        if torque is not None:
            # The controller hears that its commands are in force before it sees their effect.
            self._publish_safety()
            self._write(self._target.write(torque))
            self._passed += 1
            self._delay.add(time.monotonic_ns() - self.inbox.handled_ns)

    def _look_for_silence(self) -> None:
        if self._target.problem and self._guard.phase is Phase.PASSING:
            self._guard.stop(StopReason(StopCode.DRIVE, self._target.problem))
            self._target.stop()
        was_stopped = self._guard.stop_reason
        torque = self._guard.watch(self.now_ns)
        if torque is not None:
            self._write(self._target.write(torque))
            self._harmless += 1
        if self._guard.stop_reason and not was_stopped:
            self._target.stop()
        self._publish_safety()

    def _publish_safety(self) -> None:
        """Publish the state if it has changed."""
        phase, reason, calls = self._guard.phase, self._guard.stop_reason, self.stops_called
        if (phase, reason, calls) == self._published:
            return
        self._published = (phase, reason, calls)
        values = {"state": phase.value, STOPS_CALLED: str(calls)}
        self._safety.publish(to_stop_state(self.NAME, self.arm, reason, phase.value, values))
        if reason:
            self.say(f"no command is passed on: {reason}; call ~/reset to continue")

    def _on_settings(self, message: DiagnosticStatus) -> None:
        values, differs = read_settings(message), ""
        if message.name == CONTROLLER:
            own, name = self.settings[""].gravity_compensation, f"supervision.{_GRAVITY}"
            controllers = values.get(name, own)
            differs = f"{_GRAVITY} = {own}, and {name} = {controllers} in the controller" if controllers != own else ""
        try:
            self._disagreements[message.name] = differs or self._target.hear(message.name, values)
        except (TypeError, ValueError) as error:
            # Those of another arm, or another version.
            self._disagreements[message.name] = f"the settings of {message.name} cannot be compared: {error}"

    def look_around(self) -> None:
        """Look for rivals, and ask the drive for what is not known yet."""
        self._target.look()
        super().look_around()

    def _come_to_rest(self) -> None:
        """Stop, and send harmless torques until the arm is at rest."""
        if self._guard.phase is Phase.WAITING:
            return
        self.stop_for(requested("the adapter is deactivated"))
        began = time.monotonic()
        self._look_for_silence()
        while time.monotonic() - began < (_SLEW_S if self._guard.rests else _REST_S):
            time.sleep(self.period)
            self.inbox.poll()
            self._look_for_silence()


if __name__ == "__main__":
    sys.exit(run(AdapterNode, sys.argv))
