"""Re-execution: controller and observer run again on what they took in, and must say the same to the last digit.

The very objects that the nodes run take the recorded messages in the recorded order. With other settings the result is
what those would have said to the same states, which would soon have become other states.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.reference_messages import pose_knots, posture_knots
from contact_reach_ros.control.settings import ImpedanceSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.errors import BagError, InputError, SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget
from contact_reach_ros.observer.momentum import MomentumObserver, MomentumSettings, measured_torque
from contact_reach_ros.observer.plausibility import PlausibilityCheck, PlausibilitySettings
from contact_reach_ros.observer.safety import DISTRUST, SafetyMonitor, SafetySettings
from contact_reach_ros.parameter_files import parameters_in
from contact_reach_ros.plant.drive import checked_command
from contact_reach_ros.recording.intake import Taken
from contact_reach_ros.recording.recorded_inputs import (
    COMMANDS,
    EXTERNAL_TORQUE,
    SHADOW_COMMANDS,
    RecordedInputs,
    Row,
)
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.model import RobotModel
from contact_reach_ros.settings import Settings
from contact_reach_ros.timing import StampOrder
from contact_reach_ros.units import NANOSECONDS

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""N m: differences up to this count as none."""

MODEL = "model"
"""Stands for a node in a parameter file: its parameter inertia_set is the model that controller and observer have."""

_ERROR_LEVEL = 2
_LONG_AGO_NS = 10 * NANOSECONDS


class Difference(NamedTuple):
    """Where a re-execution first differs from the recording."""

    tick: int
    """Number of the output, counted from 1 at the start of the node."""
    stamp_ns: int
    field: str
    recorded: float | str
    recomputed: float | str

    def text(self, origin_ns: int) -> str:
        """In words, with the time since `origin_ns`."""
        since = (self.stamp_ns - origin_ns) / NANOSECONDS
        return f"tick {self.tick}, {since:.3f} s, {self.field}: recorded {self.recorded}, recomputed {self.recomputed}"


@dataclasses.dataclass(frozen=True)
class Rerun:
    """One node, executed again.

    Attributes
    ----------
    node :
        Its name.
    stamp_ns :
        (n,) of the joint states that it answered.
    values :
        (n, 7) torques or residuals as they come out now, Nm.
    recorded :
        (n, 7) as they came out then; NaN where the bag lacks them.
    checked :
        How many were compared: those that are in the bag, from where the node's state is known.
    largest_difference :
        Nm; NaN if nothing was compared.
    first_difference :
        None if there is none.
    reasons :
        Why it stopped the arm, now.
    notes :
        What could not be done, one sentence each.
    seconds :
        Time of the processor that it took.
    """

    node: str
    stamp_ns: NDArray[np.int64]
    values: Array
    recorded: Array
    checked: int
    largest_difference: float
    first_difference: Difference | None
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    seconds: float

    @property
    def duration(self) -> float:
        """Time of the robot's clock that was executed again, s."""
        return float(self.stamp_ns[-1] - self.stamp_ns[0]) / NANOSECONDS if len(self.stamp_ns) else 0.0

    @property
    def realtime_factor(self) -> float:
        """How many times faster than the robot."""
        return self.duration / self.seconds if self.seconds > 0.0 else float("nan")


class Other:
    """Settings to execute with instead of the recorded ones, from a parameter file; nothing changes without one."""

    def __init__(self, file: Path | None = None) -> None:
        """Raises `SettingsError` if the file cannot be read or names no node."""
        self.file = file
        self.values = {
            node: parameters_in(file, node) if file is not None else {}
            for node in ("controller", "observer", "planner", MODEL)
        }
        if file is not None and not any(self.values.values()):
            raise SettingsError(
                f"{file}: names none of {', '.join(self.values)}; expected '<node>: ros__parameters: ...'"
            )

    def __bool__(self) -> bool:
        return any(self.values.values())

    def section(self, inputs: RecordedInputs, node: str, prefix: str, settings: type[Settings]) -> Any:
        """Settings of a node: the recorded ones with what the file says."""
        recorded = inputs.section(node, prefix, settings)
        head = f"{prefix}." if prefix else ""
        known = [entry.name for entry in settings.declared()]
        changes = {name: self.values[node][head + name] for name in known if head + name in self.values[node]}
        return settings.from_mapping(vars(recorded) | changes, f"{self.file}: {node}")

    def budget(self, inputs: RecordedInputs, node: str) -> ContactBudget:
        """The contact budget of a node."""
        if "contact_budget" in self.values[node]:
            return load_budget(self.values[node]["contact_budget"])
        return inputs.section(node, "budget", ContactBudget)

    def model(self) -> RobotModel:
        """The model that controller and observer have."""
        return RobotModel(self.values[MODEL].get("inertia_set", "nominal"))


def rerun_controller(inputs: RecordedInputs, other: Other | None = None) -> Rerun:
    """Execute the controller again.

    Raises
    ------
    BagError
        If the bag lacks what the controller took in, or its settings.
    SettingsError
        If other settings are not accepted.
    """
    return _ControllerRun(inputs, other or Other()).run()


def rerun_observer(inputs: RecordedInputs, other: Other | None = None) -> Rerun:
    """Execute the observer again; raises as `rerun_controller` does."""
    return _ObserverRun(inputs, other or Other()).run()


class _Run:
    """What both have in common: going through the rows, comparing, and finding into step.

    A node whose beginning the bag lacks, or a joint state in between, is in an unknown state: it is given the recorded
    output as its last one until it says the same as the recording again.
    """

    node: str
    topic: str
    quantity: str

    def __init__(self, inputs: RecordedInputs, other: Other) -> None:
        if self.node not in inputs.intakes:
            raise BagError(
                f"bag '{inputs.bag.summary.path}' lacks intake/{self.node}: what the {self.node} took in is not known"
            )
        self.inputs, self.other = inputs, other
        self.intake = inputs.intakes[self.node]
        self.notes: list[str] = []
        if self.intake.lost:
            self.notes.append(f"{self.intake.lost} notes of intake/{self.node} come after a gap and are left out")
        self.lockstep = bool(inputs.settings.get(self.node, {}).get("use_sim_time", False))
        self.in_step = not self.intake.starts_late
        self.missing = 0
        self.unchecked = 0
        self.to_check: list[tuple[int, int]] = []
        """Which outputs are to be compared, and their numbers."""
        self.reasons: list[str] = []
        self.stamps: list[int] = []
        self.values: list[Array] = []
        self.rows: list[int] = []
        self.recorded = inputs.columns[self.topic].values
        self.handlers: dict[Taken, Callable[[Row], None]] = {}

    def run(self) -> Rerun:
        """Go through all rows."""
        began = time.process_time()
        for row in self.intake:
            handler = self.handlers.get(row.what)
            if handler is not None:
                handler(row)
        if self.missing:
            self.notes.append(f"{self.missing} messages that the {self.node} took in are not in the bag")
        if self.unchecked:
            self.notes.append(
                f"{self.unchecked} {self.quantity} are not compared: the {self.node}'s state is not known there"
            )
        rows = np.array(self.rows, dtype=int)
        recorded = np.full((len(rows), iiwa14.N_JOINTS), np.nan)
        recorded[rows >= 0] = self.recorded[rows[rows >= 0]]
        stamps = np.array(self.stamps, dtype=np.int64)
        values = np.reshape(self.values, (-1, iiwa14.N_JOINTS))
        checked = np.array([index for index, _ in self.to_check], dtype=int)
        differences = np.abs(values[checked] - recorded[checked])
        first = self._first_difference(stamps, values, recorded, differences)
        if first is None and not self.other:
            first = self._compare_reasons()
        return Rerun(
            self.node,
            stamps,
            values,
            recorded,
            len(checked),
            float(differences.max()) if len(checked) else float("nan"),
            first,
            tuple(self.reasons),
            tuple(self.notes),
            time.process_time() - began,
        )

    def _first_difference(
        self, stamps: NDArray[np.int64], values: Array, recorded: Array, differences: Array
    ) -> Difference | None:
        # Not `>`: what is not a number differs, too.
        off = np.flatnonzero(~(differences <= TOLERANCE).all(axis=1))
        if not off.size:
            return None
        index, output = self.to_check[int(off[0])]
        joint = int(np.argmax(np.nan_to_num(differences[off[0]], nan=np.inf)))
        field = f"{self.topic} of {iiwa14.JOINT_NAMES[joint]}"
        return Difference(output, int(stamps[index]), field, float(recorded[index, joint]), float(values[index, joint]))

    def compare(self, row: Row, stamp_ns: int, value: Array, at: int | None) -> None:
        """Keep one output, and compare it with row `at` of the recorded ones, None if the bag lacks it."""
        self.stamps.append(stamp_ns)
        self.values.append(value)
        self.rows.append(-1 if at is None else at)
        if at is None or self.other:
            return
        if not self.in_step:
            self.in_step = float(np.abs(value - self.recorded[at]).max()) <= TOLERANCE
            if not self.in_step:
                self.unchecked += 1
                return
        self.to_check.append((len(self.values) - 1, row.output))

    def lose(self) -> None:
        """Something is missing: what follows cannot be compared until it agrees."""
        self.missing += 1
        self.in_step = False

    def recorded_reasons(self) -> list[str]:
        """Why the node stopped the arm, each time once."""
        reasons: list[str] = []
        for reason in self.inputs.safety_reasons(self.node):
            if not reasons or reasons[-1] != reason:
                reasons.append(reason)
        return reasons

    def _compare_reasons(self) -> Difference | None:
        recorded = self.recorded_reasons()
        whole = self.in_step and not self.intake.starts_late and not self.intake.lost
        if not whole or recorded == self.reasons:
            return None
        at = self.stamps[-1] if self.stamps else 0
        return Difference(len(self.stamps), at, "stop reasons", str(recorded), str(self.reasons))


class _ControllerRun(_Run):
    node = "controller"
    quantity = "commands"

    def __init__(self, inputs: RecordedInputs, other: Other) -> None:
        settings = ControllerSettings(
            other.section(inputs, "controller", "impedance", ImpedanceSettings),
            other.section(inputs, "controller", "limits", LimitSettings),
            other.section(inputs, "controller", "supervision", SupervisionSettings),
        )
        self.topic = (
            SHADOW_COMMANDS if inputs.section("controller", "supervision", SupervisionSettings).shadow else COMMANDS
        )
        super().__init__(inputs, other)
        self.controller = Controller(settings, other.model())
        self.outputs = inputs.by_output(self.topic)
        self.started = False
        self.order = StampOrder()
        self.state_ns = 0
        self.state: tuple[Array, Array] | None = None
        self.told = iter(self.recorded_reasons())
        self.handlers = {
            Taken.ACTIVATE: self._activate,
            Taken.JOINT_STATES: self._tick,
            Taken.SAFETY_STATE: self._safety,
            Taken.REFERENCE_POSE: self._reference,
            Taken.REFERENCE_POSTURE: self._reference,
            Taken.STOP: self._stop,
            Taken.RESET: self._reset,
        }

    def _clock_ns(self, row: Row) -> int:
        return self.state_ns if self.lockstep else row.clock_ns

    def _activate(self, row: Row) -> None:
        self.started = False

    def _tick(self, row: Row) -> None:
        at = self.inputs.state_row(row.sent_ns)
        if at is None:
            self.lose()
            return
        states, controller = self.inputs.states, self.controller
        stamp_ns = int(states.stamp_ns[at])
        if self.started and not self.order.is_new(stamp_ns):
            return
        self.state_ns = stamp_ns
        q, v = states.position[at], states.velocity[at]
        recorded = self.outputs.get(row.output) if row.gave_output else None
        if not self.in_step and recorded is not None:
            self._find_into_step(q, v, row.output)
        try:
            if not self.started:
                if not row.gave_output:
                    # It was refused: by other publishers, or for its values.
                    return
                controller.start(q, v, self.state_ns)
                self.started = True
                self.order.is_new(stamp_ns)
            torque = controller.tick(q, v, self.state_ns, self._clock_ns(row))
        except InputError:
            return
        self.state = (q, v)
        self._note_stop()
        if torque is not None:
            self.compare(row, self.state_ns, torque, recorded)

    def _find_into_step(self, q: Array, v: Array, output: int) -> None:
        """The torque goes on from the last recorded one; who was started before, was so long ago."""
        if not self.started:
            try:
                self.controller.start(q, v, self.state_ns - _LONG_AGO_NS)
            except InputError:
                return
            self.started = True
        before = self.outputs.get(output - 1)
        if before is not None:
            self.controller.continue_from(self.recorded[before])

    def _safety(self, row: Row) -> None:
        message = self.inputs.message(row.what, row.sent_ns)
        if message is None:
            self.missing += 1
            return
        if message.name == "observer" and self.started:
            reason = message.message if _level(message.level) >= _ERROR_LEVEL else ""
            distrust = next((item.value for item in message.values if item.key == DISTRUST), "")
            self.controller.observer_report(reason, self._clock_ns(row), distrust)

    def _reference(self, row: Row) -> None:
        message = self.inputs.message(row.what, row.sent_ns)
        if message is None:
            self.lose()
            return
        references = self.controller.references
        try:
            if row.what is Taken.REFERENCE_POSE:
                references.offer_poses(pose_knots(message), self.state_ns)
            else:
                references.offer_postures(posture_knots(message), self.state_ns)
        except InputError:
            return

    def _stop(self, row: Row) -> None:
        self.controller.stop(next((reason for reason in self.told if reason not in self.reasons), "stopped by a call"))

    def _reset(self, row: Row) -> None:
        if self.state is None:
            return
        try:
            self.controller.reset(*self.state, self.state_ns, self._clock_ns(row))
        except InputError:
            return

    def _note_stop(self) -> None:
        reason = self.controller.stop_reason
        if reason and (not self.reasons or self.reasons[-1] != reason):
            self.reasons.append(reason)


class _ObserverRun(_Run):
    node = "observer"
    topic = EXTERNAL_TORQUE
    quantity = "external torques"

    def __init__(self, inputs: RecordedInputs, other: Other) -> None:
        super().__init__(inputs, other)
        self.observer = MomentumObserver(other.section(inputs, "observer", "momentum", MomentumSettings), other.model())
        budget = other.budget(inputs, "observer")
        self.monitor = SafetyMonitor(other.section(inputs, "observer", "safety", SafetySettings), budget)
        self.check = PlausibilityCheck(
            other.section(inputs, "observer", "plausibility", PlausibilitySettings), budget.contact_thresholds
        )
        source = {**inputs.settings.get("observer", {}), **other.values["observer"]}.get("torque_source", "measured")
        self.from_commands = source == "commanded"
        self.commanded: Array | None = None
        self.by_stamp = {stamp: row for row, stamp in enumerate(inputs.columns[self.topic].stamp_ns.tolist())}
        self.commands = {sent: row for row, sent in enumerate(inputs.columns[COMMANDS].publish_ns.tolist())}
        self.order = StampOrder()
        self.last_row: int | None = None
        self.handlers = {
            Taken.JOINT_STATES: self._take,
            Taken.COMMANDS: self._command,
            Taken.STOP: lambda _: self.monitor.stop("stop service called"),
            Taken.RESET: self._reset,
        }

    def _command(self, row: Row) -> None:
        at = self.commands.get(row.sent_ns)
        if at is None:
            self.lose()
            return
        try:
            self.commanded = checked_command(self.inputs.columns[COMMANDS].values[at])
        except InputError:
            return

    def _take(self, row: Row) -> None:
        at = self.inputs.state_row(row.sent_ns)
        if at is None:
            self.lose()
            return
        states = self.inputs.states
        stamp_ns, q, v = int(states.stamp_ns[at]), states.position[at], states.velocity[at]
        try:
            torque = self._acting_torque(states.effort[at])
        except InputError:
            return
        if not np.isfinite(q.sum() + v.sum()) or not self.order.is_new(stamp_ns):
            return
        recorded = self.by_stamp.get(stamp_ns)
        if not self.in_step and self.last_row is not None:
            self.observer.residual = self.recorded[self.last_row]
        self.observer.update(q, v, torque, stamp_ns)
        self.monitor.update(self.observer.residual, v, self.observer.known_for)
        wrong = self.check.update(q, v, self.monitor.sudden, stamp_ns)
        if wrong:
            self.monitor.stop_distrusting(wrong)
        self.last_row = recorded
        reason = self.monitor.stop_reason
        if reason and (not self.reasons or self.reasons[-1] != reason):
            self.reasons.append(reason)
        self.compare(row, stamp_ns, self.observer.residual, recorded)

    def _acting_torque(self, effort: Array) -> Array | None:
        if self.from_commands:
            torque, self.commanded = self.commanded, None
            return torque
        return measured_torque(effort)

    def _reset(self, row: Row) -> None:
        try:
            self.monitor.reset()
        except InputError:
            return


def _level(level: Any) -> int:
    return level[0] if isinstance(level, bytes) else int(level)


def realtime_factor(reruns: Mapping[str, Rerun]) -> float:
    """How many times faster than the robot controller and observer together were executed again."""
    seconds = sum(rerun.seconds for rerun in reruns.values())
    return max((rerun.duration for rerun in reruns.values()), default=0.0) / seconds if seconds else float("nan")
