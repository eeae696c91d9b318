"""Inputs of a re-execution: what the nodes of a bag took in, in their order."""

from __future__ import annotations

import dataclasses
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.joint_state import JointState
from contact_reach_ros.bags.columns import Arrays, Collector, JointStates, read_raw
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.recorded_arm import SETTINGS, recorded_arm
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.intake import COLUMNS, TOPICS, Taken
from contact_reach_ros.messages.safety_state import read_reason
from contact_reach_ros.messages.values import checked_stamp, read_settings
from contact_reach_ros.reexecution.settings import recorded_sections
from contact_reach_ros.timing import NANOSECONDS

JOINT_STATES = TOPICS[Taken.JOINT_STATES]
COMMANDS = TOPICS[Taken.COMMANDS]
ADAPTER_COMMANDS = "adapter/commands"
SHADOW_COMMANDS = "shadow/commands"
EXTERNAL_TORQUE = "external_torque"
OBSTACLES = "obstacles"

_PLAIN = (*(name for name in TOPICS.values() if name not in (JOINT_STATES, COMMANDS)), OBSTACLES)
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
        (n, 4), columns `intake.COLUMNS`, without gaps.
    starts_late :
        Whether the node had taken in something before.
    lost :
        Rows after a gap, which cannot be used: what came in between is not known.
    """

    rows: NDArray[np.int64]
    starts_late: bool
    lost: int

    def __iter__(self) -> Iterator[Row]:
        # Whether the last one gave something is not known; only a joint state can.
        for (what, sent, clock, outputs), (*_, after) in zip(
            self.rows[:-1].tolist(), self.rows[1:].tolist(), strict=True
        ):
            yield Row(Taken(what), sent, clock, after > outputs, after)
        for what, sent, clock, outputs in self.rows[-1:].tolist():
            if what != Taken.JOINT_STATES:
                yield Row(Taken(what), sent, clock, False, outputs)


class RecordedInputs:
    """A bag's inputs of controller, observer and planner by the time at which they were sent.

    Raises `BagError` if the bag has no joint states, or no node recorded what it took in.

    Parameters
    ----------
    bag :
        The recording.

    Attributes
    ----------
    settings :
        Recorded settings by node and full name.
    arm :
        The arm that was recorded, with its tool.
    columns :
        Messages of joint states, commands and external torques, by topic.
    intakes :
        What each node took in.
    """

    def __init__(self, bag: BagReader) -> None:
        self.bag = bag
        self._reports: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
        for status in self.messages(SETTINGS):
            self._reports[status.name].append(read_settings(status))
        self.settings = {node: values[-1] for node, values in self._reports.items()}
        self.arm = recorded_arm(self.settings)
        joints = self.arm.n
        columns: dict[str, Collector] = {
            JOINT_STATES: JointStates(("position", "velocity", "effort"), self.arm.joint_names),
            COMMANDS: Arrays(joints),
            ADAPTER_COMMANDS: Arrays(joints),
            SHADOW_COMMANDS: Arrays(joints),
            EXTERNAL_TORQUE: JointStates(("effort",), self.arm.joint_names),
        }
        self._plain: defaultdict[str, dict[int, RawMessage]] = defaultdict(dict)
        batches: dict[str, list[RawMessage]] = {node: [] for node in ("controller", "observer")}
        handlers: dict[str, Collector | Callable[[RawMessage], None]] = {}
        handlers |= {f"/{name}": column for name, column in columns.items()}
        handlers |= {f"/{name}": partial(_keep, self._plain[name]) for name in _PLAIN}
        handlers |= {f"/intake/{node}": batch.append for node, batch in batches.items()}
        read_raw(bag, handlers)
        self.columns = {name: column.column() for name, column in columns.items()}
        self.intakes = {node: _join(map(bag.decode, batch)) for node, batch in batches.items() if batch}
        if not len(self.columns[JOINT_STATES]):
            raise BagError(f"bag '{bag.summary.path}' has no joint states: nothing can be re-executed")
        if not self.intakes:
            raise BagError(
                f"bag '{bag.summary.path}' lacks what the nodes took in, on intake/controller and intake/observer: "
                "record it with a stack that publishes them"
            )
        self._rows = {sent: row for row, sent in enumerate(self.columns[JOINT_STATES].publish_ns.tolist())}

    @property
    def origin_ns(self) -> int:
        """Stamp of the first joint state, ns."""
        return int(self.columns[JOINT_STATES].stamp_ns[0])

    def state(self, sent_ns: int) -> JointState | None:
        """The joint state that was sent at that time; None if the bag lacks it.

        Raises `InputError` if its stamp is none that the nodes accept.
        """
        row = self._rows.get(sent_ns)
        if row is None:
            return None
        states = self.columns[JOINT_STATES]
        stamp_ns = checked_stamp(*divmod(int(states.stamp_ns[row]), NANOSECONDS), "joint_states")
        q, v, torque = states.values[row].reshape(3, -1)
        return JointState(stamp_ns, q, v, torque)

    def message(self, name: str, sent_ns: int) -> Any:
        """The decoded message of a topic that was sent at that time; None if the bag lacks it."""
        raw = self._plain[name].get(sent_ns)
        return None if raw is None else self.bag.decode(raw)

    def data_until(self, name: str, sent_ns: int) -> Iterator[bytes]:
        """The serialized messages of a topic up to one that was sent at that time, which the bag may lack."""
        kept = self._plain[name]
        if sent_ns in kept:
            yield from (kept[each].data for each in sorted(kept) if each <= sent_ns)

    def messages(self, name: str) -> Iterator[Any]:
        """The decoded messages of a topic, which the bag may lack."""
        topic = f"/{name}"
        if topic in self.bag.topics():
            for item in self.bag.messages([topic]):
                yield item.message

    def safety_reasons(self, node: str) -> list[str]:
        """Why a node stopped the arm, each time once, in the order of the bag."""
        statuses = (self.bag.decode(raw) for raw in self._plain["safety_state"].values())
        reasons = [read_reason(status) for status in statuses if status.name == node]
        # A reason is published again when something else changes.
        return [reason for reason, _ in itertools.groupby(filter(None, reasons))]

    def by_output(self, topic: str) -> dict[int, int]:
        """Row of each message of a column by the number that its publisher gave it."""
        sequence = self.columns[topic].sequence
        if not sequence.any():
            # A middleware without numbers: losses cannot be seen, so none are assumed.
            sequence = np.arange(1, len(sequence) + 1)
        return {number: row for row, number in enumerate(sequence.tolist())}

    def by_stamp(self, topic: str) -> dict[int, int]:
        """Row of each message of a column by its stamp, ns."""
        return {stamp: row for row, stamp in enumerate(self.columns[topic].stamp_ns.tolist())}

    def sections(self, node: str) -> dict[str, Any]:
        """The settings objects of a node by prefix, as they were.

        Raises `BagError` if the bag lacks them, or they are not those of this version.
        """
        path = self.bag.summary.path
        if node not in self.settings:
            raise BagError(f"bag '{path}' lacks the settings of the {node} on topic '{SETTINGS}'")
        return recorded_sections(node, self.settings[node], path)

    def arm_of(self, node: str) -> Arm:
        """The arm that a node had, with its tool; raises `BagError` if its tool changed."""
        first, *others = (recorded_arm({node: values}) for values in self._reports[node])
        if any(other != first for other in others):
            raise BagError(
                f"bag '{self.bag.summary.path}': the tool of the {node} changes; expected a bag of one tool, which "
                "alone can be re-executed"
            )
        return first


def _join(messages: Iterable[Any]) -> Intake:
    """Batches in their order, up to the first gap; those that came twice count once."""
    width = len(COLUMNS)
    batches = [message.data for message in messages if message is not None]
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
