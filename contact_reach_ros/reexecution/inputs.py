"""Inputs of a re-execution: what the nodes of a bag took in, in their order."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arms import ROBOT_DIGEST, ROBOT_TABLE, known_parameters, make_settings
from contact_reach_ros.bags.columns import Arrays, Collector, Column, JointStates, Times
from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.signals import SETTINGS, recorded_arm, settings_of_bag
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.intake import TOPICS, Taken, read_batch
from contact_reach_ros.messages.safety_state import read_reason
from contact_reach_ros.messages.values import checked_stamp
from contact_reach_ros.observer.budget import BUDGET, ContactBudget, load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.planning.settings import PLANNER_SECTIONS
from contact_reach_ros.removed import removed_parameter
from contact_reach_ros.settings import (
    Sections,
    check_node_names,
    check_values,
    parameters_in,
)
from contact_reach_ros.timing import NANOSECONDS

JOINT_STATES = TOPICS[Taken.JOINT_STATES]
COMMANDS = "effort_controller/commands"
ADAPTER_COMMANDS = "adapter/commands"
SHADOW_COMMANDS = "shadow/commands"
EXTERNAL_TORQUE = "external_torque"

SECTIONS: Mapping[str, Sections] = {
    "controller": {**CONTROLLER_SECTIONS, **OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "observer": {**OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "planner": {**PLANNER_SECTIONS, **CONTROLLER_SECTIONS, BUDGET: ContactBudget},
}
"""What the nodes that are re-executed record, by parameter prefix."""

_OF_BAGS = (ROBOT_DIGEST, ROBOT_TABLE, "contact_budget")
"""What nodes report of their arm, beside parameters, and the file that the planner's budget once came from."""

_PLAIN = tuple(name for name in TOPICS.values() if name != JOINT_STATES)
"""Topics of few messages, which are decoded when they are asked for."""
_PACKED = np.dtype([("what", "u1"), ("sent", "i8"), ("clock", "i8"), ("gave", "?"), ("output", "u4")])


class Row(NamedTuple):
    """One intake of a node."""

    what: Taken
    sent_ns: int
    clock_ns: int
    gave_output: bool
    """Whether the node published something for it."""
    output: int
    """The number of that, counted from 1 at the start of the node; of its last one if it gave none."""


class Intake(NamedTuple):
    """What one node took in."""

    rows: NDArray[np.void]
    """The fields of each `Row`, in their order, without gaps."""
    starts_late: bool
    """Whether the node had taken in something before."""
    lost: int
    """Rows after a gap, which cannot be used: what came in between is not known."""

    def each(self) -> Iterator[Row]:
        """Yield the rows."""
        for packed in self.rows:
            what, *values = packed.item()
            yield Row(Taken(what), *values)


class Numbered:
    """The messages of a column by a number that each of them has."""

    def __init__(self, column: Column, numbers: Times) -> None:
        """`numbers`: (n,) those of the messages."""
        self.column = column
        self._order = np.argsort(numbers, kind="stable")
        self._numbers = numbers[self._order]

    def row(self, number: int) -> int | None:
        """Place in the column of the last message with this number; None without any."""
        at = int(np.searchsorted(self._numbers, number, side="right")) - 1
        return int(self._order[at]) if at >= 0 and self._numbers[at] == number else None

    def get(self, number: int) -> Array | None:
        """Values (k,) of the last message with this number; None without any."""
        row = self.row(number)
        return None if row is None else self.column.values[row]


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
    origin_ns :
        Stamp of the first joint state, ns.
    outputs :
        Commands by topic and the number that their publisher gave them, and external torques by their stamp, ns.
    """

    def __init__(self, bag: BagReader) -> None:
        self.bag = bag
        self.settings = settings_of_bag(bag)
        self.arm = recorded_arm(self.settings)
        joints, names = self.arm.n, self.arm.joint_names
        columns: dict[str, Collector] = {name: Arrays(joints) for name in (COMMANDS, ADAPTER_COMMANDS, SHADOW_COMMANDS)}
        columns[JOINT_STATES] = JointStates(("position", "velocity", "effort"), names)
        columns[EXTERNAL_TORQUE] = JointStates(("effort",), names)
        self._plain: dict[str, dict[int, RawMessage]] = {name: {} for name in _PLAIN}
        handlers: dict[str, Callable[[Messages], None]] = {f"/{name}": each for name, each in columns.items()}
        handlers |= {f"/{name}": partial(self._keep, name) for name in self._plain}
        bag.pass_on(handlers)
        states = columns.pop(JOINT_STATES).column()
        if not len(states):
            raise BagError(f"bag '{bag.path}' has no joint states: nothing can be re-executed")
        self.origin_ns = int(states.stamp_ns[0])
        self._states = Numbered(states, states.publish_ns)
        self.outputs = {name: _numbered(name, each.column()) for name, each in columns.items()}
        if not any(f"/intake/{node}" in bag.topics for node in ("controller", "observer")):
            raise BagError(
                f"bag '{bag.path}' lacks what the nodes took in, on intake/controller and intake/observer: "
                "record it with a stack that publishes them"
            )

    def intake(self, node: str) -> Intake:
        """What a node took in: batches in their order, up to the first gap; those that came twice count once.

        Raises `BagError` if the bag has none.
        """
        known = list(Taken)
        by_first: dict[int, NDArray[np.void]] = {}
        for message in self.bag.messages(f"/intake/{node}"):
            first, batch = read_batch(message)
            if len(batch):
                rows = np.zeros(len(batch), _PACKED)
                rows["what"], rows["sent"], rows["clock"], rows["output"] = batch.T
                by_first[first] = rows
        if not by_first:
            raise BagError(f"bag '{self.bag.path}' lacks intake/{node}: what the {node} took in is not known")
        taken, lost, begin = [], 0, min(by_first)
        expected = begin
        for first in sorted(by_first):
            if first == expected:
                taken.append(by_first[first][np.isin(by_first[first]["what"], known)])
                expected += len(by_first[first])
            else:
                lost += len(by_first[first])
        rows = np.concatenate(taken)
        # A row has the number of outputs before it.
        after = rows["output"][1:].copy()
        rows["gave"][:-1] = after > rows["output"][:-1]
        rows["output"][:-1] = after
        # Whether the last one gave something is not known; only a joint state can.
        if len(rows) and rows["what"][-1] == Taken.JOINT_STATES:
            rows = rows[:-1]
        return Intake(rows, begin > 0, lost)

    def state(self, sent_ns: int) -> JointState | None:
        """The joint state that was sent at that time; None if the bag lacks it.

        Raises `InputError` if its stamp is none that the nodes accept.
        """
        row = self._states.row(sent_ns)
        if row is None:
            return None
        states = self._states.column
        q, v, torque = states.values[row].reshape(3, -1)
        stamp_ns = checked_stamp(*divmod(int(states.stamp_ns[row]), NANOSECONDS), "joint_states")
        return JointState(stamp_ns, q, v, torque)

    def message(self, name: str, sent_ns: int) -> Any:
        """The decoded message of a topic that was sent at that time; None if the bag lacks it."""
        raw = self._plain[name].get(sent_ns)
        return None if raw is None else self.bag.decode(raw)

    def safety_reasons(self, node: str) -> list[str]:
        """Why a node stopped the arm, each time once, in the order of the bag."""
        reasons = (read_reason(status) for status in self.bag.messages("/safety_state") if status.name == node)
        # A reason is published again when something else changes.
        return [reason for reason, _ in itertools.groupby(filter(None, reasons))]

    def _keep(self, name: str, messages: Messages) -> None:
        for _, *row in messages.tolist():
            raw = RawMessage(f"/{name}", *row)
            self._plain[name].setdefault(raw.publish_time_ns, raw)

    def sections(self, node: str) -> dict[str, Any]:
        """The settings objects of a node by prefix, as they were.

        Raises `BagError` if the bag lacks them, or they are not those of this version.
        """
        if node not in self.settings:
            raise BagError(f"bag '{self.bag.path}' lacks the settings of the {node} on topic '{SETTINGS}'")
        return recorded_sections(node, self.settings[node], self.arm, self.bag.path)


def _numbered(topic: str, column: Column) -> Numbered:
    if topic == EXTERNAL_TORQUE:
        return Numbered(column, column.stamp_ns)
    # A middleware may give no numbers: losses cannot be seen then, so none are assumed.
    return Numbered(column, np.where(column.sequence == 0, np.arange(1, len(column) + 1), column.sequence))


def recorded_sections(node: str, recorded: Mapping[str, Any], arm: Arm, bag: object) -> dict[str, Any]:
    """The settings objects of a node by prefix; `recorded` are its values by full name.

    Settings that version 0.2 had and this one has as constants are left out: re-execution shows whether they differed.

    Raises
    ------
    BagError
        If a name or a value is none of this version's: the node may have worked in another way. `bag` is named.
    """
    try:
        return make_settings(
            _still_known(node, recorded, arm), SECTIONS[node], arm, f"bag '{bag}', settings of the {node}"
        )
    except SettingsError as error:
        raise BagError(f"{error}; use the version that recorded the bag") from error


def _still_known(node: str, recorded: Mapping[str, Any], arm: Arm) -> dict[str, Any]:
    """Recorded values without those that are constants now, and without what nodes report beside parameters."""
    known = known_parameters(SECTIONS[node], arm)
    return {
        name: value
        for name, value in recorded.items()
        if name in known or not (name in _OF_BAGS or removed_parameter(name.removeprefix(f"{BUDGET}.")))
    }


def changed_sections(node: str, recorded: Mapping[str, Any], arm: Arm, file: Path) -> dict[str, Any]:
    """As `recorded_sections`, with the values that a parameter file has for controller or observer on top.

    Raises `SettingsError` if the file has nothing for these nodes, or something that they do not accept.
    """
    check_node_names(file)
    changes = {}
    for each in ("controller", "observer"):
        changes[each] = parameters_in(file, each)
        check_values(changes[each], known_parameters(SECTIONS[each], arm), f"{file}: {each}")
    if not any(changes.values()):
        raise SettingsError(f"{file}: has nothing for controller or observer; expected '<node>: ros__parameters: ...'")
    # The controller watches itself with the observer's settings.
    own = changes[node] | changes["observer"]
    made = make_settings({**_still_known(node, recorded, arm), **own}, SECTIONS[node], arm, f"{file}: {node}")
    if "contact_budget" in own:
        made[BUDGET] = load_budget(own["contact_budget"]).resolve(arm)
    return made
