"""The controller's node: one torque command for every joint state."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.logging import LoggingSeverity
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.control.agreement import differences, disagreement
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS, SupervisionSettings
from contact_reach_ros.control.supervisor import Mode
from contact_reach_ros.errors import InputError, StopCode, StopReason, internal, requested
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.diagnostics import to_stop_state
from contact_reach_ros.messages.intake import Taken
from contact_reach_ros.messages.references import pose_knots, posture_knots
from contact_reach_ros.messages.safety_state import observer_values, read_in_force, read_verdict
from contact_reach_ros.messages.serialized import CommandWriter, JointStateReader
from contact_reach_ros.messages.values import read_settings
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import MEASURED, OBSERVER_SECTIONS, ObserverSettings
from contact_reach_ros.ros.graph import LOOK_AROUND_S, rivalry
from contact_reach_ros.ros.interfaces import ALONE, OBSERVER
from contact_reach_ros.ros.lockstep import BEHIND_ADAPTER
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import run
from contact_reach_ros.ros.scheduling import CONTROLLER_PRIORITY, Role
from contact_reach_ros.settings import Settings, full_name
from contact_reach_ros.timing import Histogram, write_counts

NAME = "controller"
_PLANNER = "planner"
_BUDGET = "budget"
_OWN_FILE = "contact_budget"
"""Setting of the observer that may differ: the same budget may lie in two files."""


class ControllerNode(ManagedNode):
    """Passes joint states, references and safety states to the controller and publishes its torques."""

    NAME = NAME
    SECTIONS = CONTROLLER_SECTIONS

    def __init__(self) -> None:
        super().__init__()
        self._watch = self._watch_settings()
        supervision: SupervisionSettings = self.settings["supervision"]
        commands = topics.COMMANDS
        self._exclusive: tuple[topics.Topic, ...] = (*ALONE, topics.SAFETY_STATE)
        if supervision.adapter:
            commands = topics.ADAPTER_COMMANDS
            self._exclusive += (commands,)
        if supervision.shadow:
            commands = topics.SHADOW_COMMANDS
        self._write_commands = self.make_writer(commands.kept(self.lockstep))
        self._safety = self.make_publisher(topics.SAFETY_STATE)
        self._lockstep = self.make_lockstep(BEHIND_ADAPTER if commands is topics.ADAPTER_COMMANDS else NAME)
        # Safety before joint states: a tick uses everything that came before it. Plans take effect later, and reading
        # one takes as long as a tick, so they come after it; not in lockstep, where a tick uses them, too, and nothing
        # is late.
        self.inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)
        self.inbox.add(topics.REFERENCE_POSE, self._on_poses, hurried=self.lockstep)
        self.inbox.add(topics.REFERENCE_POSTURE, self._on_postures, hurried=self.lockstep)
        if self._lockstep.active:
            self.inbox.add(topics.LOCKSTEP_HORIZON, self._lockstep.hear, topics.EVERY)
        ready = self.turn_in(self._lockstep)
        self.inbox.add(topics.JOINT_STATES, self._on_state, self._lockstep.qos, serialized=True, ready=ready)
        self._intake = self.log_intake(topics.CONTROLLER_INTAKE)
        self.offer("~/stop", self._answer_stop)
        self.offer("~/reset", self._answer_reset)
        self.inbox.add(topics.SETTINGS, self._on_settings, topics.ALL_EVENTS)
        self._others: dict[str, Mapping[str, Any]] = {}
        """Settings that planner and observer have reported."""
        self._disagreement = ""
        """What the planner plans with and this controller has not."""
        self._other_watch = ""
        """What the observer watches with and this controller's own watch has not."""
        needs_effort = bool(self._watch) and ObserverSettings.from_sections(self._watch).torque_source == MEASURED
        self._reader = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name, needs_effort)
        self._writer = CommandWriter(self.arm.n)
        self._controller = self._make_controller()
        if self._watch:
            self._controller.watch_with(self._make_watcher())
        self._controller.not_yet = "still looking for other publishers"
        self._compute = Histogram()
        self._published_mode: tuple[Mode, str] | None = None
        self.every(LOOK_AROUND_S, self._look_around)

    def configure(self) -> None:
        """Warm up all computations."""
        self._make_controller().rehearse()
        if self._watch:
            self._make_watcher().rehearse()

    def files(self) -> Mapping[str, Settings]:
        """The observer's settings, with which the controller watches itself; empty if it does not."""
        return self._watch

    def activate(self) -> None:
        """Start from the next joint state."""
        self._controller.activate()
        self._look_around()

    def on_fault(self, what: str, error: Exception) -> None:
        """Stop the arm: after a fault of its program nobody knows what the controller goes on from."""
        if not self._controller.stop_reason:
            reason = internal(what, error)
            self.inbox.post(lambda: self._stop_for(reason))

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Mode, plan age and computing time."""
        controller = self._controller
        waiting = "" if controller.started else controller.not_yet or controller.not_vouched
        values = {
            "mode": controller.mode.value,
            **observer_values(self.settings["supervision"].require_observer),
            "plans accepted": controller.references.accepted,
            "plan halves unpaired": controller.references.unpaired,
            "plan age s": controller.references.age(controller.stamp_ns),
            "position error m": float(np.linalg.norm(controller.error[:3])),
            "observer silence max ms": 1000.0 * controller.supervisor.longest_silence,
            "joint states repeated": controller.order.repeated,
            "joint states older": controller.order.older,
            **{f"compute {key} us": value for key, value in self._compute.summary().items()},
            "compute counts": write_counts(self._compute.counts()),
        }
        return controller.stop_reason or waiting, values

    def _make_controller(self) -> Controller:
        settings = ControllerSettings(self.settings["impedance"], self.settings["limits"], self.settings["supervision"])
        return Controller(self.arm, settings, self.period)

    def _watch_settings(self) -> Mapping[str, Settings]:
        """Settings and budget of the observer by prefix; none if the controller does not watch itself."""
        if not self.settings["supervision"].has_own_watch:
            return {}
        sections = settings_of(self.ARGUMENTS, OBSERVER, OBSERVER_SECTIONS, self.arm)
        return {**sections, _BUDGET: load_budget(sections[""].contact_budget).resolve(self.arm)}

    def _make_watcher(self) -> Observer:
        settings = ObserverSettings.from_sections(self._watch)
        budget: Any = self._watch[_BUDGET]
        return Observer(self.arm, settings, budget, self._controller.watch_period, locates=False)

    def _look_around(self) -> None:
        """Check that nobody else publishes commands, or what they follow from; runs beside the loop."""
        # A controller in the shadow mode runs beside another one that commands.
        controller = self._controller
        rivals, differs = rivalry(self, self._exclusive), self._other_watch
        controller.not_yet = f"{rivals}: end the others first" if rivals else differs
        if (rivals or differs) and controller.started and not controller.stop_reason:
            code = StopCode.RIVAL if rivals else StopCode.DISAGREEMENT
            reason = StopReason(code, rivals or differs)
            self.inbox.post(lambda: self._stop_for(reason))

    def _clock_ns(self) -> int:
        """Time of the watchdogs' clock: steady, or simulated in lockstep, where real time means nothing."""
        return self._controller.stamp_ns if self.lockstep else self.inbox.handled_ns

    def _on_state(self, data: bytes) -> None:
        controller = self._controller
        state = self._reader.read(data)
        clock_ns = state.stamp_ns if self.lockstep else self.inbox.handled_ns
        torque = controller.update(state, clock_ns)
        if controller.state is not state:
            controller.watch(state, None, clock_ns)
            return
        while controller.references.dropped:
            self.refuse("plans", InputError(controller.references.dropped.pop()))
        if not self.lockstep:
            self._answer(state.stamp_ns, torque)
        controller.watch(state, torque, clock_ns)
        if (controller.mode, controller.stop_reason) != self._published_mode:
            self._publish_safety()
        if self.lockstep:
            # Time goes on with the answer, and everything else must be out by then. It does not begin before the
            # observer vouches: how often the first state is repeated until then depends on the machine.
            waits = self._lockstep.time_stands(state.stamp_ns) and torque is None and not controller.started
            if not waits:
                self._answer(state.stamp_ns, torque)

    def _answer(self, stamp_ns: int, torque: Array | None) -> None:
        if torque is not None:
            self._write_commands(self._writer.write(torque))
            self._intake.outputs += 1
        else:
            self._lockstep.answer(stamp_ns)
        self._compute.add(time.monotonic_ns() - self.inbox.handled_ns)

    def _on_settings(self, message: DiagnosticStatus) -> None:
        if message.name in (_PLANNER, OBSERVER):
            self._others[message.name] = read_settings(message)
            self._compare()

    def _compare(self) -> None:
        own = self.reported_settings()
        self._disagreement = disagreement(own, self._others.get(_PLANNER, {}))
        if self._watch:
            names = [
                full_name(prefix, entry.name)
                for prefix, settings in self._watch.items()
                for entry in settings.declared()
                if entry.name != _OWN_FILE
            ]
            differs = differences(own, self._others.get(OBSERVER, {}), OBSERVER, names)
            hint = "start both with the same parameter file, or with supervision.watch_itself: false"
            self._other_watch = f"observer and controller disagree: {differs}; {hint}" if differs else ""

    def _check_agreement(self) -> None:
        if self._disagreement:
            raise InputError(
                f"planner and controller disagree: {self._disagreement}; its plans are not followed: start both with "
                "the same parameters"
            )

    def _on_poses(self, message: MultiDOFJointTrajectory) -> None:
        self._check_agreement()
        self._controller.references.offer_poses(pose_knots(message), self._controller.stamp_ns)

    def _on_postures(self, message: JointTrajectory) -> None:
        self._check_agreement()
        knots = posture_knots(message, self.arm.joint_names)
        self._controller.references.offer_postures(knots, self._controller.stamp_ns)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        if message.name == OBSERVER:
            self._controller.hear(read_verdict(message), self._clock_ns())
        elif self.settings["supervision"].adapter:
            self._controller.in_force = read_in_force(message, self._controller.in_force)

    def _publish_safety(self) -> None:
        controller = self._controller
        self._published_mode = (controller.mode, controller.stop_reason)
        if controller.stop_reason:
            # Bags must not end between a stop and what led to it.
            self._intake.flush()
        mode = controller.mode.value
        values = {"mode": mode, **observer_values(self.settings["supervision"].require_observer)}
        self._safety.publish(to_stop_state(NAME, self.arm, controller.stop_reason, mode, values))
        if controller.stop_reason:
            is_silent = controller.mode is Mode.SILENT
            what = "stop, without commands" if is_silent else "compliant stop"
            calls = "~/reset, and the driver's," if is_silent else "~/reset"
            self.say(LoggingSeverity.ERROR, f"{what}: {controller.stop_reason}; call {calls} to continue")

    def _answer_stop(self) -> str:
        # The loop may be slow to answer, but it will stop.
        self.inbox.post(lambda: self._stop_for(requested("stop service called")))
        return "compliant stop"

    def _stop_for(self, reason: str) -> None:
        self.note_call(Taken.STOP)
        self._controller.stop(reason)

    def _answer_reset(self) -> str:
        # In the loop's thread, because it might be in the middle of a tick.
        self.inbox.call(self._reset)
        return "holding; send a goal to continue"

    def _reset(self) -> None:
        self._controller.check_ready()
        self.note_call(Taken.RESET)
        self._controller.reset(self._clock_ns())


def main() -> None:
    """Run the controller."""
    sys.exit(run(ControllerNode, Role.LOOP, sys.argv, CONTROLLER_PRIORITY))


if __name__ == "__main__":
    main()
