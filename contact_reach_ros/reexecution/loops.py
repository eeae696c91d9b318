"""Re-execution of controller and observer on what they took in, the same to the last digit.

The very objects that the nodes run take the recorded messages in the recorded order. With other settings the result
is how they would have answered the same states, which would soon have become other states.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import BLIND_AFTER, Array, JointState
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.errors import BagError, InputError, SettingsError, requested
from contact_reach_ros.messages.intake import TOPICS, Taken
from contact_reach_ros.messages.plan_reader import PlanReader
from contact_reach_ros.messages.safety_state import read_in_force, read_verdict
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.observer.budget import BUDGET
from contact_reach_ros.observer.observer import Observer
from contact_reach_ros.observer.settings import ObserverSettings
from contact_reach_ros.reexecution.inputs import (
    ADAPTER_COMMANDS,
    COMMANDS,
    EXTERNAL_TORQUE,
    SHADOW_COMMANDS,
    RecordedInputs,
    Row,
    changed_sections,
)
from contact_reach_ros.timing import NANOSECONDS, PERIOD

TOLERANCE = 1e-9
"""N m: differences up to this count as none."""

_LONG_AGO_NS = 10 * NANOSECONDS
_NEVER_NS = np.iinfo(np.int64).max


class Difference(NamedTuple):
    """Where a re-execution first differs from the recording."""

    tick: int
    """Number of the output, counted from 1 at the start of the node."""
    stamp_ns: int
    field: str
    recorded: float | str
    reexecuted: float | str

    def text(self, origin_ns: int) -> str:
        """In words, with the time since `origin_ns`."""
        since = (self.stamp_ns - origin_ns) / NANOSECONDS
        return f"tick {self.tick}, {since:.3f} s, {self.field}: recorded {self.recorded}, re-executed {self.reexecuted}"


def reexecute(node: str, inputs: RecordedInputs, other: Path | None = None) -> Loop:
    """Re-execute the controller or the observer, with other settings if there is a parameter file with them.

    Raises `BagError` if the bag lacks its inputs or settings, `SettingsError` if the other ones are not accepted.
    """
    loop = (_ControllerLoop if node == "controller" else _ObserverLoop)(inputs, other)
    loop.run()
    return loop


class Loop:
    """One node, re-executed: it takes the rows in order, compares outputs, and gets into step.

    A node whose beginning the bag lacks, or a joint state in between, is in an unknown state: it continues from the
    recorded outputs until it agrees with the recording again.

    Attributes
    ----------
    node :
        Its name.
    outputs :
        Number of its torques or residuals.
    compared :
        How many were compared: those that are in the bag, from where the node's state is known.
    largest_difference :
        N m; NaN if nothing was compared. With other settings the largest change, though nothing counts as compared.
    first_difference :
        None if there is none.
    reasons :
        Why the re-executed node stopped the arm.
    """

    def __init__(self, node: str, inputs: RecordedInputs, other: Path | None) -> None:
        self.node, self.inputs, self.settings = node, inputs, inputs.sections(node)
        self.period = 1.0 / float(inputs.settings[node].get("state_rate", 1.0 / PERIOD))
        self.topic = EXTERNAL_TORQUE
        if node == "controller":
            supervision = self.settings["supervision"]
            self.topic = ADAPTER_COMMANDS if supervision.adapter else COMMANDS
            if supervision.shadow:
                self.topic = SHADOW_COMMANDS
        self.simulated = bool(inputs.settings[node].get("use_sim_time", False))
        self.is_changed = other is not None
        if other is not None:
            self.settings = changed_sections(node, inputs.settings[node], inputs.arm, other)
        self.intake = inputs.intake(node)
        self.in_step = not self.intake.starts_late
        self.uncertain_until_ns = 0
        """Stamp from which on nothing that was lost is in force any more, ns."""
        self.missing = self.uncompared = self.compared = self.outputs = self.last_stamp_ns = 0
        self.largest_difference = float("nan")
        self.first_difference: Difference | None = None
        self.reasons: list[str] = []
        self.unpublished = ""
        """Reason of a stop after which no joint state was executed."""
        self.recorded_reasons = inputs.safety_reasons(node)
        self.handlers: dict[Taken, Callable[[Row], None]] = {}

    def run(self) -> None:
        """Go through all rows."""
        for row in self.intake.each():
            if row.what in self.handlers:
                with contextlib.suppress(InputError):  # as the node refused it
                    self.handlers[row.what](row)
        self.first_difference = self.first_difference or self._other_reasons()

    def make_observer(self, **options: Any) -> Observer:
        """An observer of the node's settings."""
        settings = ObserverSettings.from_sections(self.settings)
        return Observer(self.inputs.arm, settings, self.settings[BUDGET], self.period, **options)

    def give(self, row: Row, stamp_ns: int, value: Array, recorded: Array | None) -> None:
        """Compare an output with the recorded one, unless the bag lacks it."""
        self.outputs, self.last_stamp_ns = self.outputs + 1, stamp_ns
        if recorded is None:
            return
        difference = np.abs(value - recorded)
        if self.is_changed:
            self.largest_difference = float(np.fmax(self.largest_difference, difference.max()))
            return
        # Not `>`: what is not a number differs, too.
        is_equal = bool((difference <= TOLERANCE).all())
        self.in_step = self.in_step or (is_equal and stamp_ns >= self.uncertain_until_ns)
        if not self.in_step:
            self.uncompared += 1
            return
        self.compared += 1
        self.largest_difference = float(np.fmax(self.largest_difference, difference.max()))
        if not is_equal and self.first_difference is None:
            joint = int(np.argmax(np.nan_to_num(difference, nan=np.inf)))
            field = f"{self.topic} of {self.inputs.arm.joint_names[joint]}"
            self.first_difference = Difference(row.output, stamp_ns, field, float(recorded[joint]), float(value[joint]))

    def lose(self) -> None:
        """Note that a message is missing: what follows cannot be compared until it agrees."""
        self.missing += 1
        self.in_step = False

    def note_reason(self, reason: str) -> None:
        """Note why the node stops the arm; empty while it does not."""
        self.unpublished = ""
        if reason and self.reasons[-1:] != [reason]:
            self.reasons.append(reason)

    def next_stop(self) -> str:
        """The reason of a stop that came from outside of the messages: the recorded one that is due."""
        recorded = self.recorded_reasons
        return recorded[min(len(self.reasons), len(recorded) - 1)] if recorded else requested()

    @property
    def notes(self) -> tuple[str, ...]:
        """What could not be done, one sentence each."""
        counts = {
            f"notes of intake/{self.node} come after a gap and are left out": self.intake.lost,
            f"messages that the {self.node} took in are not in the bag": self.missing,
            f"outputs are not compared: the {self.node}'s state is not known there": self.uncompared,
        }
        return tuple(f"{count} {text}" for text, count in counts.items() if count)

    def _other_reasons(self) -> Difference | None:
        """The difference if the node stopped the arm for other reasons than the recorded ones."""
        recorded = self.recorded_reasons
        is_whole = self.compared and self.in_step and not self.intake.starts_late and not self.intake.lost
        # Whether a stop after the last joint state was published, the bag does not tell.
        if self.is_changed or not is_whole or recorded in (self.reasons, [*self.reasons, self.unpublished]):
            return None
        return Difference(self.outputs, self.last_stamp_ns, "stop reasons", str(recorded), str(self.reasons))


class _ControllerLoop(Loop):
    def __init__(self, inputs: RecordedInputs, other: Path | None) -> None:
        super().__init__("controller", inputs, other)
        hold = self.settings[BUDGET].handover_thresholds
        settings = ControllerSettings.from_sections(self.settings)
        try:
            self.controller = Controller(inputs.arm, settings, self.period, hold=hold)
        except SettingsError as error:
            if other is not None:
                raise
            raise BagError(f"bag '{inputs.bag.path}': {error}; use the version that recorded the bag") from error
        self.watch = self.make_observer(locates=False, blind_after=BLIND_AFTER)
        self.controller.watch_with(self.watch)
        self.plans = PlanReader(self.controller)
        self.residuals = inputs.outputs[EXTERNAL_TORQUE]
        self.last_residual: Array | None = None
        self.recorded = inputs.outputs[self.topic]
        self.handlers = {
            Taken.ACTIVATE: lambda _: self.controller.activate(),
            Taken.JOINT_STATES: self._tick,
            Taken.SAFETY_STATE: self._hear,
            Taken.REFERENCE_POSE: self._follow,
            Taken.REFERENCE_POSTURE: self._follow,
            Taken.STOP: self._stop,
            Taken.RESET: lambda row: self.controller.reset(self._clock_ns(row)),
        }

    def _stop(self, _: Row) -> None:
        self.controller.stop(self.next_stop())
        self.unpublished = self.controller.stop_reason

    def _clock_ns(self, row: Row) -> int:
        """Time of the watchdogs' clock, ns; rows have the steady clock also where time is simulated."""
        return self.controller.stamp_ns if self.simulated else row.clock_ns

    def _tick(self, row: Row) -> None:
        state = self.inputs.state(row.sent_ns)
        if state is None:
            self.lose()
            return
        controller = self.controller
        recorded = self.recorded.get(row.output) if row.gave_output else None
        if not self.in_step and recorded is not None:
            self._get_into_step(state, row.output)
        # A state that did not start the controller was refused: because of other publishers, or for its values.
        controller.not_yet = "" if row.gave_output else "refused then"
        clock_ns = state.stamp_ns if self.simulated else row.clock_ns
        try:
            torque = controller.update(state, clock_ns)
        finally:
            controller.not_yet = ""
        self.note_reason(controller.stop_reason)
        if controller.state is state and torque is not None:
            self.give(row, state.stamp_ns, torque, recorded)
        controller.watch(state, clock_ns)
        self.last_residual = self.residuals.get(state.stamp_ns)
        self.note_reason(controller.stop_reason)

    def _get_into_step(self, state: JointState, output: int) -> None:
        """Continue from the last recorded torque; a controller that was started before, was so long ago."""
        if not self.controller.started:
            self.controller.start(state.q, state.v, state.stamp_ns - _LONG_AGO_NS)
        before = self.recorded.get(output - 1)
        if before is not None:
            self.controller.resume(before)
        if self.last_residual is not None:
            self.watch.momentum.residual = self.last_residual

    def _hear(self, row: Row) -> None:
        message = self.inputs.message(TOPICS[row.what], row.sent_ns)
        if message is None:
            self.missing += 1
        elif message.name == "observer":
            self.controller.hear(read_verdict(message, self.inputs.arm), self._clock_ns(row))
        elif self.controller.settings.supervision.adapter:
            self.controller.in_force = read_in_force(message, self.controller.in_force)

    def _follow(self, row: Row) -> None:
        message, queue = self.inputs.message(TOPICS[row.what], row.sent_ns), self.controller.follower.queue
        if message is None:
            self.lose()
            self.uncertain_until_ns = _NEVER_NS  # the plan that is lost may take effect at any time
            return
        accepted = queue.accepted
        if row.what is Taken.REFERENCE_POSE:
            self.plans.take_poses(message)
        else:
            self.plans.take_postures(message)
        if self.uncertain_until_ns == _NEVER_NS and queue.accepted > accepted:
            self.uncertain_until_ns = nanoseconds(message.header.stamp)
        elif not message.points:
            self.uncertain_until_ns = 0  # all plans are withdrawn


class _ObserverLoop(Loop):
    def __init__(self, inputs: RecordedInputs, other: Path | None) -> None:
        super().__init__("observer", inputs, other)
        self.observer = self.make_observer()
        self.recorded = inputs.outputs[self.topic]
        self.last_recorded: Array | None = None
        self.handlers = {
            Taken.JOINT_STATES: self._update,
            Taken.STOP: self._stop,
            Taken.RESET: self._reset,
        }
        self._seen_ns = 0
        """When the last new state came, on the steady clock."""

    def _stop(self, _: Row) -> None:
        self.unpublished = self.next_stop()
        self.observer.stop(self.unpublished)

    def _reset(self, row: Row) -> None:
        self.observer.reset(0.0 if self.simulated else (row.clock_ns - self._seen_ns) / NANOSECONDS)

    def _update(self, row: Row) -> None:
        state = self.inputs.state(row.sent_ns)
        if state is None:
            self.lose()
            return
        if not self.in_step and self.last_recorded is not None:
            self.observer.momentum.residual = self.last_recorded
        report = self.observer.update(state)
        if report is not None:
            self._seen_ns = row.clock_ns
            self.last_recorded = self.recorded.get(state.stamp_ns)
            self.note_reason(report.verdict.reason)
            self.give(row, state.stamp_ns, report.residual, self.last_recorded)
