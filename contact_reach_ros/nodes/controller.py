"""The controller's node: one torque command for every joint state."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from contact_reach_ros.agreement import OF_PLANS, differences
from contact_reach_ros.arm import BLIND_AFTER
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, ControllerSettings, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, StopCode, StopReason
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_stop_state
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.messages.plan_reader import PlanReader
from contact_reach_ros.messages.safety_state import STOPS_CALLED, read_in_force, read_verdict
from contact_reach_ros.messages.serialized import JointStateReader, command_writer
from contact_reach_ros.messages.values import read_settings
from contact_reach_ros.observer.budget import BUDGET, load_budget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS, ObserverSettings
from contact_reach_ros.ros.interfaces import ADAPTER, ALONE, OBSERVER, PLANNER
from contact_reach_ros.ros.managed_node import StoppableNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import Durations

_OF_THE_OBSERVER = tuple(f"{prefix}." for prefix in (*OBSERVER_SECTIONS, BUDGET) if prefix)
"""Settings that have to be the observer's; not `contact_budget`, as the same budget may lie in two files."""


class ControllerNode(StoppableNode):
    """Passes joint states, references and safety states to the controller and publishes its torques."""

    NAME = "controller"
    SECTIONS = CONTROLLER_SECTIONS
    STOPPED = "compliant stop"
    RELEASED = "holding; reset the driver, too, if its brakes are closed, then send a goal"

    def __init__(self) -> None:
        super().__init__()
        supervision: SupervisionSettings = self.settings["supervision"]
        self._watches = supervision.has_own_watch
        if self._watches:
            self.settings |= settings_of(self.ARGUMENTS, OBSERVER, OBSERVER_SECTIONS, self.arm)
            self.settings[BUDGET] = load_budget(self.settings[""].contact_budget).resolve(self.arm)
        adapted = [topics.ADAPTER_COMMANDS] if supervision.adapter else []
        commands = topics.SHADOW_COMMANDS if supervision.shadow else next(iter(adapted), topics.COMMANDS)
        self._write_commands = self.make_writer(commands)
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        # Safety before joint states: a tick uses everything that came before it. Plans take effect later, and reading
        # one takes as long as a tick, so they come after it.
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self._intake = self.log_intake(topics.CONTROLLER_INTAKE)
        self.inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS, hurried=False)
        self._disagreement = ""
        """What the planner plans with and this controller has not."""
        self._other_watch = ""
        """What the observer watches with and this controller's own watch has not."""
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._writer = command_writer(self.arm.n)
        self._controller = self._make_controller()
        plans = PlanReader(self._controller)
        self.inbox.add(topics.REFERENCE_POSE, partial(self._on_half, plans.take_poses), hurried=False)
        self.inbox.add(topics.REFERENCE_POSTURE, partial(self._on_half, plans.take_postures), hurried=False)
        if self._watches:
            self._controller.watch_with(self._make_watcher())
        self._controller.not_yet = "still looking for other publishers"
        self._compute = Durations()
        self._published: tuple[Mode, str, int] | None = None
        self.exclude([*ALONE, topics.SAFETY_STATE, *adapted])
        after = [ADAPTER] if commands is topics.ADAPTER_COMMANDS else []
        self.follow(topics.JOINT_STATES, self._on_state, after=after)

    def configure(self) -> None:
        """Warm up all computations."""
        self._make_controller().rehearse()
        if self._watches:
            self._make_watcher().rehearse()

    def activate(self) -> None:
        """Start from the next joint state."""
        self._controller.activate()
        self.look_around()

    @property
    def stop_reason(self) -> str:
        """Why the arm is stopped; empty if it is not."""
        return self._controller.stop_reason

    @property
    def is_engaged(self) -> bool:
        """Whether the controller has started."""
        return self._controller.started

    def stop_for(self, reason: str) -> None:
        """Stop the arm, compliant."""
        self.note_call(Taken.STOP)
        self._controller.stop(reason)

    def reset(self) -> None:
        """Release a stop: the arm holds. Raises `InputError` if it may not be released yet."""
        self._controller.check_ready()
        self.note_call(Taken.RESET)
        self._controller.reset(self.arrived_ns)

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Mode, plan age and computing time."""
        controller = self._controller
        waiting = "" if controller.started else controller.not_yet or controller.not_vouched
        values = {
            "mode": controller.mode.value,
            "plans accepted": controller.follower.queue.accepted,
            "plan age s": controller.follower.queue.age(controller.stamp_ns),
            "position error m": float(np.linalg.norm(controller.error[:3])),
            "observer silence max ms": 1000.0 * controller.supervisor.longest_silence,
            "joint states repeated": controller.order.repeated,
            "joint states older": controller.order.older,
            **{f"compute {key} us": value for key, value in self._compute.summary().items()},
        }
        return controller.stop_reason or waiting, values

    def _make_controller(self) -> Controller:
        settings = ControllerSettings.from_sections(self.settings)
        hold = self.settings[BUDGET].handover_thresholds if self._watches else None
        return Controller(self.arm, settings, self.period, hold=hold)

    def _make_watcher(self) -> Observer:
        settings = ObserverSettings.from_sections(self.settings)
        budget = self.settings[BUDGET]
        return Observer(self.arm, settings, budget, self.period, locates=False, blind_after=BLIND_AFTER)

    def look_around(self) -> None:
        """Look for rivals, and for an observer whose settings differ: beside either the arm does not start."""
        super().look_around()
        controller, differs = self._controller, self._other_watch
        controller.not_yet = f"{self.rivals}: end the others first" if self.rivals else differs
        if differs and controller.started:
            self.stop_once(StopReason(StopCode.DISAGREEMENT, differs))

    def _on_state(self, data: bytes) -> None:
        controller = self._controller
        state = self._reader.read(data)
        clock_ns = self.arrived_ns
        torque = controller.update(state, clock_ns)
        if controller.state is not state:
            controller.watch(state, clock_ns)
            return
        while controller.follower.queue.dropped:
            self.refuse("plans", InputError(controller.follower.queue.dropped.pop()))
        if torque is not None:
            self._write_commands(self._writer.write(torque))
            self._intake.outputs += 1
        self._compute.add(time.monotonic_ns() - self.inbox.handled_ns)
        controller.watch(state, clock_ns)
        if (controller.mode, controller.stop_reason, self.stops_called) != self._published:
            self._publish_safety()

    def _on_settings(self, message: DiagnosticStatus) -> None:
        own = self.reported_settings()
        if message.name == PLANNER:
            self._disagreement = differences(own, read_settings(message), PLANNER, OF_PLANS)
        elif message.name == OBSERVER and self._watches:
            differs = differences(own, read_settings(message), OBSERVER, _OF_THE_OBSERVER)
            hint = "start both with the same parameter file, or with supervision.watch_itself: false"
            self._other_watch = f"observer and controller disagree: {differs}; {hint}" if differs else ""

    def _on_half(self, take: Callable[[Any], None], message: Any) -> None:
        """Take the poses or postures of a plan; raises as `PlanReader`, or if the planner plans with other settings."""
        if self._disagreement:
            raise InputError(
                f"planner and controller disagree: {self._disagreement}; its plans are not followed: start both with "
                "the same parameters"
            )
        take(message)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if message.name == OBSERVER:
            self._controller.hear(read_verdict(message, self.arm), self.arrived_ns)
        elif self.settings["supervision"].adapter:
            self._controller.in_force = read_in_force(message, self._controller.in_force)

    def _publish_safety(self) -> None:
        controller = self._controller
        self._published = (controller.mode, controller.stop_reason, self.stops_called)
        if controller.stop_reason:
            # Bags must not end between a stop and what led to it.
            self._intake.flush()
        mode = controller.mode.value
        values = {"mode": mode, STOPS_CALLED: str(self.stops_called)}
        self._safety.publish(to_stop_state(self.NAME, self.arm, controller.stop_reason, mode, values))
        if controller.stop_reason:
            is_silent = controller.mode is Mode.SILENT
            what = "stop, without commands" if is_silent else "compliant stop"
            calls = "~/reset, and the driver's," if is_silent else "~/reset"
            self.say(f"{what}: {controller.stop_reason}; call {calls} to continue")


if __name__ == "__main__":
    sys.exit(run(ControllerNode, sys.argv))
