"""What the nodes took in, read back from a bag: the inputs of a re-execution."""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.recording.bag_reader import BagReader, RawMessage
from contact_reach_ros.recording.columns import Arrays, Collector, JointStates, array_numbers, read_raw
from contact_reach_ros.recording.intake import COLUMNS, TOPICS, Taken
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.settings import Settings

Array = NDArray[np.float64]

NODES = ("controller", "observer", "planner")
SETTINGS = "settings"
COMMANDS = "effort_controller/commands"
SHADOW_COMMANDS = "shadow/commands"
EXTERNAL_TORQUE = "external_torque"

_PLAIN = ("reference/pose", "reference/posture", "obstacles", "goal_pose", "safety_state")
"""Topics of few messages, which are decoded when they are asked for."""


class Row(NamedTuple):
    """One intake of a node."""

    what: Taken
    sent_ns: int
    clock_ns: int
    gave_output: bool
    """Whether the node published something for it."""
    output: int
    """The number of that, counted from 1 at the start of the node."""


@dataclasses.dataclass(frozen=True)
class Intake:
    """What one node took in.

    Attributes
    ----------
    rows :
        (n, 4) as `intake.COLUMNS` says, without gaps.
    starts_late :
        Whether the node had taken in something before.
    lost :
        Rows after a gap, which cannot be used: what came in between is not known.
    """

    rows: NDArray[np.int64]
    starts_late: bool
    lost: int

    def __iter__(self) -> Iterator[Row]:
        # Whether the last one gave something is not known.
        for (what, sent, clock, outputs), (*_, after) in zip(
            self.rows[:-1].tolist(), self.rows[1:].tolist(), strict=True
        ):
            yield Row(Taken(what), sent, clock, after > outputs, after)


class States(NamedTuple):
    """Joint states of a bag."""

    stamp_ns: NDArray[np.int64]
    position: Array
    velocity: Array
    effort: Array


class RecordedInputs:
    """A bag's inputs of controller, observer and planner, by the time at which they were sent.

    Parameters
    ----------
    bag :
        The recording.
    namespace :
        Namespace of the robot's topics.

    Raises
    ------
    BagError
        If the bag has no joint states, or nodes did not tell what they took in.
    """

    def __init__(self, bag: BagReader, namespace: str = "/") -> None:
        self._bag = bag
        self._prefix = namespace.rstrip("/") + "/"
        joints = iiwa14.N_JOINTS
        columns: dict[str, Collector] = {
            "joint_states": JointStates(("position", "velocity", "effort"), iiwa14.JOINT_NAMES),
            COMMANDS: Arrays(joints),
            SHADOW_COMMANDS: Arrays(joints),
            EXTERNAL_TORQUE: JointStates(("effort",), iiwa14.JOINT_NAMES),
        }
        self._plain: defaultdict[str, dict[int, RawMessage]] = defaultdict(dict)
        batches: defaultdict[str, list[NDArray[np.int64]]] = defaultdict(list)
        handlers: dict[str, Collector | Callable[[RawMessage], None]] = {}
        handlers |= {self._prefix + name: column for name, column in columns.items()}
        handlers |= {self._prefix + name: partial(_keep, self._plain[name]) for name in _PLAIN}
        handlers |= {f"{self._prefix}intake/{node}": partial(_keep_numbers, batches[node]) for node in NODES}
        read_raw(bag, handlers)
        self.columns = {name: column.column() for name, column in columns.items()}
        self.intakes = {node: _join(batches[node]) for node in NODES if batches[node]}
        if not len(self.columns["joint_states"]):
            raise BagError(f"bag '{bag.summary.path}' has no joint states: nothing can be executed again")
        if not self.intakes:
            raise BagError(
                f"bag '{bag.summary.path}' does not say what the nodes took in: it lacks intake/controller and "
                "intake/observer; record it with a stack that publishes them"
            )
        self.settings = self._read_settings()
        values = self.columns["joint_states"].values
        self.states = States(
            self.columns["joint_states"].stamp_ns,
            values[:, :joints],
            values[:, joints : 2 * joints],
            values[:, 2 * joints :],
        )
        self._rows = {sent: row for row, sent in enumerate(self.columns["joint_states"].publish_ns.tolist())}

    @property
    def bag(self) -> BagReader:
        """Where the inputs come from."""
        return self._bag

    def topic(self, name: str) -> str:
        """Full name of a topic."""
        return self._prefix + name

    def state_row(self, sent_ns: int) -> int | None:
        """Row of the joint state that was sent at that time; None if the bag lacks it."""
        return self._rows.get(sent_ns)

    def message(self, what: Taken, sent_ns: int) -> Any:
        """The decoded message that was sent at that time; None if the bag lacks it."""
        raw = self.raw_message(what, sent_ns)
        return None if raw is None else self._bag.decode(raw)

    def raw_message(self, what: Taken, sent_ns: int) -> RawMessage | None:
        """The same as it was received."""
        return self._plain[TOPICS[what]].get(sent_ns)

    def safety_reasons(self, node: str) -> list[str]:
        """Why a node stopped the arm, in the order of the bag."""
        statuses = [self._bag.decode(raw) for raw in self._plain["safety_state"].values()]
        return [status.message for status in statuses if status.name == node and _level(status.level) >= 2]

    def by_output(self, topic: str) -> dict[int, int]:
        """Row of each message of a column by the number that its publisher gave it."""
        sequence = self.columns[topic].sequence
        if not sequence.any():
            # A middleware without numbers: nothing was lost, or nobody can know.
            sequence = np.arange(1, len(sequence) + 1)
        return {number: row for row, number in enumerate(sequence.tolist())}

    def section(self, node: str, prefix: str, settings: type[Settings]) -> Any:
        """Settings of a node as they were; `prefix` is '' for its own.

        Raises
        ------
        BagError
            If the bag does not tell them.
        """
        told = self.settings.get(node)
        if told is None:
            raise BagError(
                f"bag '{self._bag.summary.path}' does not tell the settings of the {node}: it lacks them on topic "
                f"'{SETTINGS}'"
            )
        head = f"{prefix}." if prefix else ""
        known = {entry.name for entry in settings.declared()}
        values = {name: told[head + name] for name in known if head + name in told}
        try:
            return settings.from_mapping(values, f"bag '{self._bag.summary.path}', settings of the {node}")
        except SettingsError as error:
            raise BagError(str(error)) from error

    def _read_settings(self) -> dict[str, dict[str, Any]]:
        topic = self._prefix + SETTINGS
        told: dict[str, dict[str, Any]] = {}
        if topic in self._bag.topics():
            for message in self._bag.messages([topic]):
                told[message.message.name] = read_settings(message.message)
        return told


def read_settings(status: Any) -> dict[str, Any]:
    """The values of a message on topic `settings`; one that is no JSON stays text."""
    values: dict[str, Any] = {}
    for entry in status.values:
        try:
            values[entry.key] = json.loads(entry.value)
        except ValueError:
            values[entry.key] = entry.value
    return values


def _join(batches: Sequence[NDArray[np.int64]]) -> Intake:
    """Batches in their order, up to the first gap; those that came twice count once."""
    width = len(COLUMNS)
    by_first = {int(batch[0]): batch[1:] for batch in batches if len(batch) > width and (len(batch) - 1) % width == 0}
    rows: list[NDArray[np.int64]] = []
    expected: int | None = None
    lost = 0
    for first in sorted(by_first):
        batch = by_first[first].reshape(-1, width)
        if expected is not None and first != expected:
            lost += len(batch)
            continue
        rows.append(batch)
        expected = first + len(batch)
    joined = np.concatenate(rows) if rows else np.zeros((0, width), np.int64)
    known = np.isin(joined[:, 0], [int(what) for what in Taken])
    return Intake(joined[known], bool(by_first) and min(by_first) > 0, lost)


def _keep(kept: dict[int, RawMessage], message: RawMessage) -> None:
    kept.setdefault(message.publish_time_ns, message)


def _keep_numbers(kept: list[NDArray[np.int64]], message: RawMessage) -> None:
    kept.append(array_numbers(message.data, "<i8"))


def _level(level: Any) -> int:
    return level[0] if isinstance(level, bytes) else int(level)
