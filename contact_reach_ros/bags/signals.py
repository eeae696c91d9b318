"""Arm and time series of an episode, read from a bag, as reports, the viewer and identification use them.

Times are seconds of the robot's own clock since its first joint state. Joint states, torques and contacts carry stamps
of that clock. `Clock` translates the reception times of messages without a stamp, also where the robot's clock runs at
another rate than the wall clock.
"""

from __future__ import annotations

import dataclasses
import struct
import sys
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, tip_positions
from contact_reach_ros.arms import EARLIER_DIGESTS, ROBOT_DIGEST, ROBOT_TABLE, arm_in, load_arm
from contact_reach_ros.bags.columns import Arrays, Collector, Column, JointStates, reading
from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.cdr import ARRAY_START, COUNT, HEADER, NO_LAYOUT, PLAIN_CDR, STAMP, Cursor
from contact_reach_ros.messages.intake import COLUMNS, Taken
from contact_reach_ros.messages.safety_state import is_stopped
from contact_reach_ros.messages.values import GOAL_PHASE, GOAL_STAMP, nanoseconds, read_settings
from contact_reach_ros.timing import NANOSECONDS

SETTINGS = "settings"
COMMANDS = ("adapter/commands", "effort_controller/commands")
"""Topics with the controller's torques, in the arm's order: behind an adapter the second one is the drive's."""

_ONLOOKERS = ("recorder", "viewer")
"""Nodes that may have been started apart from the stack, with another arm."""
_SPARSE = ("goal/state", "goal_pose", "safety_state", "diagnostics", "plan/statistics", SETTINGS, "intake/controller")
"""Topics with few messages."""
_LONG = 300_000
"""Messages of a topic, five minutes of a 1 kHz arm, from which on it is thinned for a report."""
_STRIDES, _STRIDE = {"joint_states": 10, "sim/contacts": 10}, 50
"""Of so many messages then one is kept, beside extremes; the distance to the goal takes a joint state each 10 ms."""

_REFUSED, _SETTLED = "refused", "settled"
"""Phases of goals that are kept: one that is not pursued, and one at which the arm is at rest."""
_KEPT_PHASES = tuple(phase.encode() for phase in (_REFUSED, _SETTLED))

_OF_PLANS = ("took ms", "cost")
"""Beginnings of the keys in plan/statistics that are kept."""
_STOP_REASON, _MISSED = b"stop reason", b"missed ticks"
"""Keys: why the search for a plan ended, and the driver's count in its diagnostics."""

_ROUNDING = 1e-9
"""Difference of two times that are equal except for rounding, s."""


class Clock:
    """Places messages on the robot's clock, in s since its first joint state, by reception and stamps of these, ns.

    Attributes
    ----------
    origin_ns :
        Stamp of the first joint state, ns.
    """

    def __init__(self, received_ns: np.ndarray, stamps_ns: np.ndarray) -> None:
        stamped = np.flatnonzero(stamps_ns)
        if not len(stamped):
            received_ns = stamps_ns = np.append(received_ns, 0)[:1]
        elif len(stamped) < len(stamps_ns):
            received_ns, stamps_ns = received_ns[stamped], stamps_ns[stamped]
        self._received_ns, self._stamps_ns = received_ns, stamps_ns
        self.origin_ns = int(stamps_ns[0])

    def of_stamps(self, stamps_ns: np.ndarray, received_ns: np.ndarray) -> np.ndarray:
        """By the stamps in the headers, or by reception where they are zero."""
        times = (stamps_ns - self.origin_ns) / NANOSECONDS
        unknown = stamps_ns == 0
        times[unknown] = self.of_receptions(received_ns[unknown])
        return times

    def of_receptions(self, received_ns: np.ndarray) -> np.ndarray:
        """By times of reception, ns."""
        known_ns, begin_ns = self._received_ns, self._received_ns[0]
        inside = np.interp(received_ns - begin_ns, known_ns - begin_ns, self._stamps_ns - self.origin_ns)
        # Outside of the joint states both clocks are taken to run alike.
        return np.asarray((inside + (received_ns - np.clip(received_ns, begin_ns, known_ns[-1]))) / NANOSECONDS)


@dataclasses.dataclass(frozen=True)
class Series:
    """Values over time.

    Attributes
    ----------
    time :
        (n,), s.
    names :
        Names of the k columns.
    values :
        (n, k); NaN where a message lacks the value.
    """

    time: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """The values (n,) of one name; all NaN without such a column."""
        if name not in self.names:
            return np.full(len(self.time), np.nan)
        return self.values[:, self.names.index(name)]

    def between(self, start: float, end: float) -> Series:
        """The part from `start` to `end`, s, both included."""
        inside = (self.time >= start) & (self.time <= end)
        return Series(self.time[inside], self.names, self.values[inside])


@dataclasses.dataclass(frozen=True)
class SafetyEvent:
    """A change of a node's safety state.

    Time in s, level of the DiagnosticStatus (0: OK), name of the node, message, and whether the state is a stop.
    """

    time: float
    level: int
    name: str
    message: str
    is_stop: bool


@dataclasses.dataclass(frozen=True)
class EpisodeSignals:
    """The signals of an episode; a series is empty where its topic was not recorded.

    Attributes
    ----------
    clock :
        Translates stamps and reception times to the times of the series.
    position, velocity, effort :
        Joint states, rad, rad/s, Nm.
    command :
        Commanded torques, Nm.
    external_torque :
        Residual of the momentum observer, Nm.
    contact_force :
        True contact force in simulation, N: a column per robot body, and the columns "sum" and "max".
    safety :
        Changes of the safety states, ordered by time; repetitions are left out.
    safety_states :
        All safety states: time, s, and decoded message; of a report those of the changes.
    goals :
        Positions of the goals that the planner accepted, m: the columns x, y and z.
    refused_goals :
        Positions of the goals that the planner refused, likewise.
    settled :
        (n,) times at which the planner reported that the arm has settled at its goal, s.
    missed_ticks :
        The driver's count of missed ticks: one column.
    plans :
        Solve time and costs of the plans by key, at the times at which they take effect.
    stop_reasons :
        Why the search for each of the plans ended.
    ticks :
        (n,) times of all joint states, s, also where the series are thinned.
    state_sent_ns :
        (n,) when they were sent, ns since the epoch.
    answers_ns :
        (n,) from the sending of a joint state to the sending of its command, ns.
    settings :
        Settings by node.
    notes :
        Irregularities of the messages, one sentence each.
    """

    clock: Clock
    position: Series
    velocity: Series
    effort: Series
    command: Series
    external_torque: Series
    contact_force: Series
    safety: tuple[SafetyEvent, ...]
    safety_states: Sequence[tuple[float, Any]]
    goals: Series
    refused_goals: Series
    settled: np.ndarray
    missed_ticks: Series
    plans: Series
    stop_reasons: tuple[str, ...]
    ticks: np.ndarray
    state_sent_ns: np.ndarray
    answers_ns: np.ndarray
    settings: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...]

    @property
    def origin_ns(self) -> int:
        """Stamp of the first joint state, at time 0, ns."""
        return self.clock.origin_ns

    def plan_age(self, times: np.ndarray) -> np.ndarray:
        """Time (n,), s, since the plan in force at each of the times (n,), s, took effect; NaN before the first."""
        rows = np.searchsorted(self.plans.time, times + _ROUNDING, side="right") - 1
        return np.asarray(times - np.append(self.plans.time, np.nan)[rows])


def settings_of_bag(bag: BagReader) -> dict[str, Mapping[str, Any]]:
    """The last settings of each node."""
    return {status.name: read_settings(status) for status in bag.messages(f"/{SETTINGS}")}


def arm_of_bag(bag: BagReader) -> Arm:
    """The arm that the nodes of a bag had, with its last tool; raises `BagError` as `recorded_arm`."""
    return recorded_arm(settings_of_bag(bag))


def recorded_arm(settings: Mapping[str, Mapping[str, Any]]) -> Arm:
    """The arm that nodes had, with its tool; `settings` are the recorded ones by node.

    Raises `BagError` if this version does not have it, or has another one of that name.
    """
    found: Arm | None = None
    for node, values in settings.items():
        try:
            arm = arm_in(values, f"settings of the {node}")
        except SettingsError as error:
            raise BagError(str(error)) from error
        digest = values.get(ROBOT_DIGEST, arm.digest)
        # A table is the arm itself.
        if digest not in (arm.digest, *EARLIER_DIGESTS.get(arm.digest, ())) and ROBOT_TABLE not in values:
            raise BagError(
                f"settings of the {node}: the arm '{arm.name}' had digest {digest}, this version's has {arm.digest}; "
                "use the version that recorded the bag"
            )
        if node not in _ONLOOKERS:
            found = found or arm
    return found or load_arm()


def read_signals(
    bag: BagReader, arm: Arm, watch: Mapping[str, Callable[[Column], None]] | None = None
) -> EpisodeSignals:
    """Read an episode; joints and contact links are mapped by name to those of the arm.

    `watch` is for reports, which keep little of a long recording: long series are thinned so that no peak is lost, and
    its functions are given all messages of a topic, part by part.
    """
    joints, count = arm.joint_names, arm.n
    commands = next((name for name in COMMANDS if f"/{name}" in bag.topics), COMMANDS[-1])
    columns: dict[str, Collector] = {
        "joint_states": JointStates(("position", "velocity", "effort"), joints),
        commands: Arrays(count),
        "external_torque": JointStates(("effort",), joints),
        "sim/contacts": JointStates(("effort",), (*arm.contact_links, "sum", "max")),
    }
    # Times in ns, and numbers of commands.
    ticks, sent, answered = ([array(code) for code in codes] for codes in (("q", "q", "q"), ("I", "q"), ("I", "q")))
    columns["joint_states"].watches.append(lambda part: _extend(ticks, part.log_ns, part.stamp_ns, part.publish_ns))
    columns[commands].watches.append(lambda part: _extend(sent, part.sequence, part.publish_ns))
    for name, column in columns.items():
        topic = bag.topics.get(f"/{name}")
        if watch is not None and topic is not None and topic.message_count > _LONG:
            column.stride = _STRIDES.get(name, _STRIDE)
        if watch is not None and name in watch:
            column.watches.append(watch[name])
    sparse: dict[str, list[tuple[int, Any]]] = {name: [] for name in _SPARSE}
    plans: list[_Plan] = []
    unread: Counter[str] = Counter()
    take: dict[str, Callable[[RawMessage], Any]] = {
        "diagnostics": lambda raw: list(_missed_ticks(raw.data)) or None,
        "goal/state": lambda raw: bag.decode(raw) if any(phase in raw.data for phase in _KEPT_PHASES) else None,
        "intake/controller": lambda raw: _extend(answered, *_answered(raw.data)),
        "plan/statistics": lambda raw: plans.extend(_plans(raw.data)),
    }
    if watch is not None:
        last: dict[bytes, tuple[int, bytes]] = {}
        take["safety_state"] = lambda raw: None if _is_repeated(raw.data, last) else bag.decode(raw)

    def few(name: str, messages: Messages) -> None:
        """Keep of each message what is needed; those that cannot be decoded are left out, as notes say."""
        for _, *row in messages.tolist():
            raw = RawMessage(f"/{name}", *row)
            try:
                taken = take.get(name, bag.decode)(raw)
            except (struct.error, ValueError):
                unread[name] += 1
                continue
            if taken is not None:
                sparse[name].append((raw.log_time_ns, taken))

    handlers: dict[str, Callable[[Messages], None]] = {f"/{name}": column for name, column in columns.items()}
    handlers |= {f"/{name}": partial(few, name) for name in sparse}
    for _ in reading(bag, handlers):
        pass
    state, command, torque, contact = (column.column() for column in columns.values())
    answers_ns = _answers(*map(_as_array, (*sent, *answered)))
    for numbers in (*sent, *answered):
        del numbers[:]
    received_ns, stamps_ns, sent_ns = map(_as_array, ticks)
    clock = Clock(received_ns, stamps_ns)

    def received(name: str) -> list[tuple[float, Any]]:
        """Time, s, and what is kept of a message."""
        times = clock.of_receptions(np.array([log_ns for log_ns, _ in sparse[name]], np.int64)).tolist()
        return list(zip(times, (taken for _, taken in sparse[name]), strict=True))

    state_times = clock.of_stamps(state.stamp_ns, state.log_ns)
    safety_states = received("safety_state")
    plans.sort(key=lambda plan: plan[0])
    keys = sorted({key for *_, names, _ in plans for key in names})
    plan_table = np.full((len(plans), len(keys)), np.nan)
    columns_of = {names: [keys.index(key) for key in names] for names in {names for *_, names, _ in plans}}
    for row, (*_, names, values) in enumerate(plans):
        plan_table[row, columns_of[names]] = values
    effects_ns = np.array([effect_ns for effect_ns, *_ in plans], np.int64)
    missed = [(time, number) for time, numbers_ in received("diagnostics") for number in numbers_]
    missed_table = np.array(missed).reshape(-1, 2)
    states = [(time, {entry.key: entry.value for entry in message.values}) for time, message in received("goal/state")]
    goals, refused_goals = _goals(received("goal_pose"), states, arm.base_frame)
    return EpisodeSignals(
        clock,
        Series(state_times, joints, state.values[:, :count]),
        Series(state_times, joints, state.values[:, count : 2 * count]),
        Series(state_times, joints, state.values[:, 2 * count :]),
        Series(clock.of_receptions(command.log_ns), joints, command.values),
        Series(clock.of_stamps(torque.stamp_ns, torque.log_ns), joints, torque.values),
        Series(clock.of_stamps(contact.stamp_ns, contact.log_ns), contact.names, contact.values),
        tuple(_changes(safety_states)),
        safety_states,
        goals,
        refused_goals,
        np.array([time for time, values in states if values.get(GOAL_PHASE) == _SETTLED]),
        Series(missed_table[:, 0], ("missed ticks",), missed_table[:, 1:]),
        Series((effects_ns - clock.origin_ns) / NANOSECONDS, tuple(keys), plan_table),
        tuple(reason for _, reason, *_ in plans),
        clock.of_stamps(stamps_ns, received_ns),
        sent_ns,
        answers_ns,
        {status.name: read_settings(status) for _, status in sparse[SETTINGS]},
        (
            *(f"{name}: {count} messages cannot be read and are left out" for name, count in unread.items()),
            *_oddities(dict(zip(columns, (state, command, torque, contact), strict=True))),
        ),
    )


def goal_distance(signals: EpisodeSignals, arm: Arm, period: float = 0.01) -> Series:
    """Distance of the flange from the goal in force; before the first goal, from the first goal.

    Parameters
    ----------
    signals :
        The episode.
    arm :
        The recorded arm.
    period :
        Spacing of the result, s; joint states in between are left out.

    Returns
    -------
    Series
        The column "distance", m; empty without goals or without joint states.
    """
    time, positions = signals.position.time, signals.position.values
    if not len(signals.goals.time) or not len(time):
        return Series(np.empty(0), ("distance",), np.empty((0, 1)))
    # The first joint state of each period, and the last of all; a stamp far from all others makes no more of them.
    _, rows = np.unique(np.floor((time - time[0]) / period + 1e-3), return_index=True)
    rows = np.union1d(rows, [len(time) - 1])
    rows = rows[np.all(np.isfinite(positions[rows]), axis=1)]
    in_force = np.maximum(np.searchsorted(signals.goals.time, time[rows], side="right") - 1, 0)
    away = tip_positions(arm, positions[rows]) - signals.goals.values[in_force]
    return Series(time[rows], ("distance",), np.linalg.norm(away, axis=1, keepdims=True))


def _is_repeated(data: bytes, last: dict[bytes, tuple[int, bytes]]) -> bool:
    """Whether a serialized status has level and message of its node's `last` one: some repeat theirs as a heartbeat."""
    cursor = Cursor(data, HEADER + 1)
    name, message = cursor.texts(2)
    state = data[HEADER], message
    is_repeated, last[name] = last.get(name) == state, state
    return is_repeated


def _changes(statuses: Sequence[tuple[float, Any]]) -> Iterator[SafetyEvent]:
    """The statuses with a new state."""
    last: dict[str, tuple[int, str]] = {}
    for time, status in statuses:
        state = (status.level, status.message)
        if last.get(status.name) != state:
            last[status.name] = state
            yield SafetyEvent(time, status.level, status.name, status.message, is_stopped(status))


_Plan = tuple[int, str, tuple[str, ...], Sequence[float]]
"""Time at which a plan takes effect, ns, why its search ended, and keys and values of its numbers."""


_Status = tuple[int, str, str, list[bytes], list[bytes]]
"""Stamp of its array, ns, name, message, and keys and values."""


def _statuses(data: bytes) -> Iterator[_Status]:
    """Yield the statuses in a serialized DiagnosticArray; an hour has a hundred thousand of them.

    Raises `struct.error` or `ValueError` if the bytes are none.
    """
    cursor = Cursor(data)
    seconds, nanosec = cursor.numbers(STAMP)
    cursor.skip(1)  # frame_id
    for _ in range(cursor.count()):
        cursor.at += 1  # level
        name, message, _ = cursor.texts(3)
        items = cursor.texts(2 * cursor.count())
        yield seconds * NANOSECONDS + nanosec, name.decode(), message.decode(), items[::2], items[1::2]


@lru_cache(64)
def _kept(keys: tuple[bytes, ...]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """The keys of numbers that are kept of a plan, and their places among all."""
    names = [key.decode() for key in keys]
    places = tuple(place for place, name in enumerate(names) if name.startswith(_OF_PLANS))
    return tuple(names[place] for place in places), places


def _plans(data: bytes) -> Iterator[_Plan]:
    for stamp_ns, _, message, keys, values in _statuses(data):
        names, places = _kept(tuple(keys))
        reason = values[keys.index(_STOP_REASON)].decode() if _STOP_REASON in keys else message
        yield stamp_ns, sys.intern(reason), names, array("d", [float(values[place]) for place in places])


def _answered(data: bytes) -> np.ndarray:
    """Of the joint states in a record of the controller's inputs the number of the next command, and sending, ns."""
    if not data.startswith(PLAIN_CDR + NO_LAYOUT):
        raise ValueError("not in plain CDR, little-endian, or with a layout")
    (count,) = COUNT.unpack_from(data, HEADER + len(NO_LAYOUT))
    batch = np.frombuffer(data, "<i8", count, ARRAY_START)
    rows = batch[1:].reshape(-1, len(COLUMNS)) if count % len(COLUMNS) == 1 else np.zeros((0, len(COLUMNS)), int)
    return np.stack([rows[:, 3] + 1, rows[:, 1]])[:, rows[:, 0] == Taken.JOINT_STATES]


def _answers(numbers: np.ndarray, sent_ns: np.ndarray, wanted: np.ndarray, states_ns: np.ndarray) -> np.ndarray:
    """From the sending of each joint state to that of its command, ns.

    `numbers` are those of the commands, `wanted` those of the commands that answer the states.
    """
    if not len(numbers):
        return np.zeros(0, np.int64)
    order = np.argsort(numbers, kind="stable")
    at = order[np.minimum(np.searchsorted(numbers, wanted, sorter=order), len(numbers) - 1)]
    # States before the start, or that came again, have no answer: the number of commands stays as it is.
    is_last = np.append(wanted[1:] != wanted[:-1], True)
    found = (sent_ns[at] - states_ns)[is_last & (numbers[at] == wanted)]
    return found[(found >= 0) & (found < NANOSECONDS)]


def _extend(arrays: Sequence[array[int]], *parts: np.ndarray) -> None:
    """Append to each array, which grows in place, a part of whole numbers."""
    for grown, part in zip(arrays, parts, strict=True):
        grown.frombytes(part.astype(grown.typecode, copy=False).tobytes())


def _as_array(numbers: array[int]) -> np.ndarray:
    return np.frombuffer(numbers, numbers.typecode)


def _oddities(columns: Mapping[str, Column]) -> Iterator[str]:
    for name, column in columns.items():
        if column.refused:
            yield f"{name}: {column.refused} messages cannot be read and are left out"
        if column.back:
            yield f"{name}: {column.back} stamps are older than the one before; curves follow the stamps"
    states = columns["joint_states"]
    joints = states.names[: len(states.names) // 3]
    for name in columns:
        if name == "sim/contacts":
            continue
        is_unknown = np.isnan(columns[name].values[:, : len(joints)])
        # Grippers have joint states of their own on the same topic.
        foreign = int(is_unknown.all(axis=1).sum()) if name == "joint_states" else 0
        lacking = int(is_unknown.any(axis=1).sum()) - foreign
        if foreign and foreign == len(is_unknown):
            yield f"joint_states: has none of the joints {', '.join(joints)}: is it another robot's?"
        elif lacking:
            yield f"{name}: at least {lacking} messages lack a number for one of the arm's {len(joints)} joints"


def _goals(
    goals: Sequence[tuple[float, Any]], states: Sequence[tuple[float, Mapping[str, str]]], base_frame: str
) -> Iterator[Series]:
    """Yield the goals that were not refused, and the others; those in other frames come again, transformed."""
    goals = [(time, message) for time, message in goals if message.header.frame_id in ("", base_frame)]
    times, places = np.array([time for time, _ in goals]), [message.pose.position for _, message in goals]
    stamps_ns = np.array([str(nanoseconds(message.header.stamp)) for _, message in goals])
    positions = np.array([(place.x, place.y, place.z) for place in places]).reshape(-1, 3)
    kept = np.isfinite(positions).all(axis=1)
    for time, values in states:
        sent = np.flatnonzero(stamps_ns == values.get(GOAL_STAMP, ""))
        if values.get(GOAL_PHASE) == _REFUSED and len(sent):
            # Stamps may be zero.
            kept[sent[np.abs(times[sent] - time).argmin()]] = False
    for some in (kept, ~kept):
        yield Series(times[some], ("x", "y", "z"), positions[some])


def _missed_ticks(data: bytes) -> Iterator[float]:
    """The driver's count of missed ticks, out of its diagnostics."""
    for _, name, _, keys, values in _statuses(data):
        if name == "driver" and _MISSED in keys:
            yield float(values[keys.index(_MISSED)])
