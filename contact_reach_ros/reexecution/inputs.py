"""Inputs of a re-execution: what the nodes of a bag took in, in their order."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from contact_reach_ros.arm import Arm, Array, JointState
from contact_reach_ros.arms import ROBOT_DIGEST, ROBOT_TABLE, known_parameters, make_settings
from contact_reach_ros.bags.columns import Arrays, Collector, JointStates, read_raw
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.signals import SETTINGS, recorded_arm
from contact_reach_ros.control.settings import CONTROLLER_SECTIONS
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.intake import COLUMNS, TOPICS, Taken
from contact_reach_ros.messages.safety_state import read_reason
from contact_reach_ros.messages.values import checked_stamp, read_settings
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
OBSTACLES = "obstacles"

SECTIONS: Mapping[str, Sections] = {
    "controller": {**CONTROLLER_SECTIONS, **OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "observer": {**OBSERVER_SECTIONS, BUDGET: ContactBudget},
    "planner": {**PLANNER_SECTIONS, **CONTROLLER_SECTIONS, BUDGET: ContactBudget},
}
"""What the nodes that are re-executed record, by parameter prefix."""

_OF_BAGS = (ROBOT_DIGEST, ROBOT_TABLE)
"""What nodes report of their arm, beside parameters."""

_PLAIN = (*(name for name in TOPICS.values() if name != JOINT_STATES), OBSTACLES)
"""Topics of few messages, which are decoded when they are asked for."""


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

    rows: list[Row]
    """In their order, without gaps."""
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
    columns :
        Messages of joint states, commands and external torques, by topic.
    intakes :
        What each node took in.
    """

    def __init__(self, bag: BagReader) -> None:
        self.bag = bag
        self.settings = {status.name: read_settings(status) for status in bag.messages(f"/{SETTINGS}")}
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
        handlers: dict[str, Callable[[RawMessage], None]] = {f"/{name}": column for name, column in columns.items()}
        handlers |= {f"/{name}": partial(_keep, self._plain[name]) for name in _PLAIN}
        handlers |= {f"/intake/{node}": batch.append for node, batch in batches.items()}
        read_raw(bag, handlers)
        self.columns = {name: column.column() for name, column in columns.items()}
        self.intakes = {node: _join(map(bag.decode, batch)) for node, batch in batches.items() if batch}
        if not len(self.columns[JOINT_STATES]):
            raise BagError(f"bag '{bag.path}' has no joint states: nothing can be re-executed")
        if not self.intakes:
            raise BagError(
                f"bag '{bag.path}' lacks what the nodes took in, on intake/controller and intake/observer: "
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

    def safety_reasons(self, node: str) -> list[str]:
        """Why a node stopped the arm, each time once, in the order of the bag."""
        statuses = (self.bag.decode(raw) for raw in self._plain["safety_state"].values())
        reasons = [read_reason(status) for status in statuses if status.name == node]
        # A reason is published again when something else changes.
        return [reason for reason, _ in itertools.groupby(filter(None, reasons))]

    def by_output(self, topic: str) -> dict[int, Array]:
        """The values of each message of a column by the number that its publisher gave it."""
        column = self.columns[topic]
        # A middleware may give no numbers: losses cannot be seen then, so none are assumed.
        numbers = column.sequence if column.sequence.any() else np.arange(1, len(column) + 1)
        return dict(zip(numbers.tolist(), column.values, strict=True))

    def by_stamp(self, topic: str) -> dict[int, Array]:
        """The values of each message of a column by its stamp, ns."""
        column = self.columns[topic]
        return dict(zip(column.stamp_ns.tolist(), column.values, strict=True))

    def sections(self, node: str) -> dict[str, Any]:
        """The settings objects of a node by prefix, as they were.

        Raises `BagError` if the bag lacks them, or they are not those of this version.
        """
        if node not in self.settings:
            raise BagError(f"bag '{self.bag.path}' lacks the settings of the {node} on topic '{SETTINGS}'")
        return recorded_sections(node, self.settings[node], self.arm, self.bag.path)


def _join(messages: Iterable[Any]) -> Intake:
    """Batches in their order, up to the first gap; those that came twice count once."""
    width, known = len(COLUMNS), set(Taken)
    batches = [message.data for message in messages if message is not None]
    by_first = {int(batch[0]): batch[1:] for batch in batches if len(batch) > width and (len(batch) - 1) % width == 0}
    taken: list[list[int]] = []
    lost, begin = 0, min(by_first, default=0)
    expected = begin
    for first in sorted(by_first):
        batch = by_first[first].reshape(-1, width).tolist()
        if first == expected:
            taken += (row for row in batch if row[0] in known)
            expected += len(batch)
        else:
            lost += len(batch)
    rows = [
        Row(Taken(what), sent, clock, after > outputs, after)
        for (what, sent, clock, outputs), (*_, after) in itertools.pairwise(taken)
    ]
    # Whether the last one gave something is not known; only a joint state can.
    for what, sent, clock, outputs in taken[-1:]:
        if what != Taken.JOINT_STATES:
            rows.append(Row(Taken(what), sent, clock, False, outputs))
    return Intake(rows, begin > 0, lost)


def _keep(kept: dict[int, RawMessage], message: RawMessage) -> None:
    kept.setdefault(message.publish_time_ns, message)


def recorded_sections(node: str, recorded: Mapping[str, Any], arm: Arm, bag: object) -> dict[str, Any]:
    """The settings objects of a node by prefix; `recorded` are its values by full name.

    Settings that version 0.2 had and this one has as constants are left out: re-execution shows whether they differed.

    Raises
    ------
    BagError
        If a name or a value is none of this version's: the node may have worked in another way. `bag` is named.
    """
    try:
        return make_settings(_still_known(recorded), SECTIONS[node], arm, f"bag '{bag}', settings of the {node}")
    except SettingsError as error:
        raise BagError(f"{error}; use the version that recorded the bag") from error


def _still_known(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Recorded values without those that are constants now, and without what nodes report beside parameters."""
    return {
        name: value
        for name, value in recorded.items()
        if name not in _OF_BAGS and not removed_parameter(name.removeprefix(f"{BUDGET}."))
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
    made = make_settings({**_still_known(recorded), **own}, SECTIONS[node], arm, f"{file}: {node}")
    if "contact_budget" in own:
        made[BUDGET] = load_budget(own["contact_budget"]).resolve(arm)
    return made
