"""Inputs of a re-execution: what the nodes of a bag took in, in their order.

The bag is read along with them, so that an hour of it takes no more memory than a minute.
"""

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
from contact_reach_ros.bags.columns import Arrays, Collector, JointStates, reading
from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.signals import SETTINGS, recorded_arm, settings_of_bag
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.intake import COLUMNS, TOPICS, Taken
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
_AHEAD_NS, _KEPT = 2 * NANOSECONDS, 20_000
"""Time by which the joint states that were read are ahead of what the node takes in, ns, and the number of messages of
each topic that are kept: twenty seconds of a 1 kHz arm."""
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
        Values of the commands by topic and the number that their publisher gave them, and of the external torques by
        their stamp, ns, around what `read_along` yields.
    """

    def __init__(self, bag: BagReader) -> None:
        self.bag = bag
        self.settings = settings_of_bag(bag)
        self.arm = recorded_arm(self.settings)
        self.outputs: dict[str, dict[int, Array]] = {
            name: {} for name in (COMMANDS, ADAPTER_COMMANDS, SHADOW_COMMANDS, EXTERNAL_TORQUE)
        }
        self._states: dict[int, tuple[int, Array]] = {}
        self._plain: dict[str, dict[int, RawMessage]] = {name: {} for name in _PLAIN}
        self._tables: list[dict[int, Any]] = [self._states, *self.outputs.values(), *self._plain.values()]
        self._begin()
        while not self._states and self._read_on():
            pass
        if not self._states:
            raise BagError(f"bag '{bag.path}' has no joint states: nothing can be re-executed")
        self.origin_ns = next(iter(self._states.values()))[0]
        if not any(f"/intake/{node}" in bag.topics for node in ("controller", "observer")):
            raise BagError(
                f"bag '{bag.path}' lacks what the nodes took in, on intake/controller and intake/observer: "
                "record it with a stack that publishes them"
            )

    def intake(self, node: str) -> Intake:
        """What a node took in: batches in their order, up to the first gap; those that came twice count once.

        Raises `BagError` if the bag has none.
        """
        width, known = len(COLUMNS), list(Taken)
        by_first: dict[int, NDArray[np.void]] = {}
        for message in self.bag.messages(f"/intake/{node}"):
            batch = message.data
            if len(batch) > width and (len(batch) - 1) % width == 0:
                rows = np.zeros((len(batch) - 1) // width, _PACKED)
                rows["what"], rows["sent"], rows["clock"], rows["output"] = batch[1:].reshape(-1, width).T
                by_first[int(batch[0])] = rows
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

    def read_along(self, intake: Intake) -> Iterator[Row]:
        """Yield what a node took in; states, messages and outputs are known from before to after each row."""
        self._begin()
        states = intake.rows["sent"][intake.rows["what"] == Taken.JOINT_STATES]
        self._read_until(int(states[0]) if len(states) else 0)
        for first in range(0, len(intake.rows), _KEPT):
            for what, *values in intake.rows[first : first + _KEPT].tolist():
                row = Row(Taken(what), *values)
                if row.what is Taken.JOINT_STATES:
                    self._read_until(row.sent_ns)
                yield row

    def state(self, sent_ns: int) -> JointState | None:
        """The joint state that was sent at that time; None if the bag lacks it.

        Raises `InputError` if its stamp is none that the nodes accept.
        """
        if sent_ns not in self._states:
            return None
        stamp_ns, values = self._states[sent_ns]
        q, v, torque = values.reshape(3, -1)
        return JointState(checked_stamp(*divmod(stamp_ns, NANOSECONDS), "joint_states"), q, v, torque)

    def message(self, name: str, sent_ns: int) -> Any:
        """The decoded message of a topic that was sent at that time; None if the bag lacks it."""
        raw = self._plain[name].get(sent_ns)
        return None if raw is None else self.bag.decode(raw)

    def safety_reasons(self, node: str) -> list[str]:
        """Why a node stopped the arm, each time once, in the order of the bag."""
        reasons = (read_reason(status) for status in self.bag.messages("/safety_state") if status.name == node)
        # A reason is published again when something else changes.
        return [reason for reason, _ in itertools.groupby(filter(None, reasons))]

    def _begin(self) -> None:
        """Begin at the start of the bag."""
        for table in self._tables:
            table.clear()
        joints, names = self.arm.n, self.arm.joint_names
        self._columns: dict[str, Collector] = {name: Arrays(joints) for name in self.outputs} | {
            JOINT_STATES: JointStates(("position", "velocity", "effort"), names),
            EXTERNAL_TORQUE: JointStates(("effort",), names),
        }
        self._counts = dict.fromkeys(self._columns, 0)
        handlers: dict[str, Callable[[Messages], None]] = {f"/{name}": each for name, each in self._columns.items()}
        handlers |= {f"/{name}": partial(self._keep, name) for name in self._plain}
        self._reading, self._read_ns = reading(self.bag, handlers), 0

    def _keep(self, name: str, messages: Messages) -> None:
        for _, *row in messages.tolist():
            raw = RawMessage(f"/{name}", *row)
            self._plain[name].setdefault(raw.publish_time_ns, raw)

    def _read_until(self, sent_ns: int) -> None:
        while self._read_ns < sent_ns + _AHEAD_NS and self._read_on():
            pass

    def _read_on(self) -> bool:
        """Read some messages, and forget the oldest ones; False at the end."""
        is_more = next(self._reading, None) is not None
        for name, collector in self._columns.items():
            part = collector.column()
            keys = part.stamp_ns
            if name == JOINT_STATES:
                self._states |= zip(part.publish_ns.tolist(), zip(keys.tolist(), part.values, strict=True), strict=True)
                self._read_ns = int(part.publish_ns.max(initial=self._read_ns))
                continue
            if name != EXTERNAL_TORQUE:
                # A middleware may give no numbers: losses cannot be seen then, so none are assumed.
                counted = self._counts[name] + np.arange(1, len(part) + 1)
                keys = np.where(part.sequence == 0, counted, part.sequence)
                self._counts[name] += len(part)
            self.outputs[name] |= zip(keys.tolist(), part.values, strict=True)
        for table in self._tables:
            for key in list(itertools.islice(table, max(len(table) - _KEPT, 0))):
                del table[key]
        return is_more

    def sections(self, node: str) -> dict[str, Any]:
        """The settings objects of a node by prefix, as they were.

        Raises `BagError` if the bag lacks them, or they are not those of this version.
        """
        if node not in self.settings:
            raise BagError(f"bag '{self.bag.path}' lacks the settings of the {node} on topic '{SETTINGS}'")
        return recorded_sections(node, self.settings[node], self.arm, self.bag.path)


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
