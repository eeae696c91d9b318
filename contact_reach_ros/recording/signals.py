"""Time series of an episode, read from a bag.

Times are seconds of the robot's own clock since its first joint state: the stamps of joint states, torques and
contacts are on that clock. Messages without a stamp are placed on it through their time of reception, compared with
those of the joint states; so an episode in lockstep, whose clock is not that of the wall, comes out right as well.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from contact_reach_ros.cdr import COUNT, HEADER, PLAIN_CDR, Status, after_string, diagnostic_array, text_at
from contact_reach_ros.recording.bag_reader import BagMessage, BagReader, RawMessage
from contact_reach_ros.recording.columns import Arrays, Collector, Column, JointStates, Stamps, array_numbers, read_raw
from contact_reach_ros.recording.intake import COLUMNS, Taken
from contact_reach_ros.recording.recorded_inputs import read_settings
from contact_reach_ros.robot.iiwa14 import JOINT_NAMES
from contact_reach_ros.units import NANOSECONDS

CONTACT_SUM = "sum"
CONTACT_MAXIMUM = "max"


@dataclasses.dataclass(frozen=True)
class Series:
    """Values over time.

    Attributes
    ----------
    time :
        (n,), s.
    names :
        What the k columns are.
    values :
        (n, k); NaN where a message had no such value.
    """

    time: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """The values (n,) of one name; NaN throughout where there is no such column."""
        if name not in self.names:
            return np.full(len(self.time), np.nan)
        return self.values[:, self.names.index(name)]


@dataclasses.dataclass(frozen=True)
class Event:
    """A change of the safety state: time in s, level of DiagnosticStatus (0: all is well), who says it and what."""

    time: float
    level: int
    name: str
    message: str
    values: Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class Goal:
    """A goal command: time in s, position (3,) in m and orientation (4,) as x, y, z, w, in `frame`."""

    time: float
    frame: str
    position: np.ndarray
    orientation: np.ndarray


@dataclasses.dataclass(frozen=True)
class PlanStatistics:
    """How one plan was found: when it takes effect, s, and what plan/statistics says of it."""

    time: float
    stop_reason: str
    numbers: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class EpisodeSignals:
    """What a bag tells of an episode; a series is empty where its topic was not recorded.

    Attributes
    ----------
    origin_ns :
        Stamp of the first joint state, at time 0, ns.
    position, velocity, effort :
        Joint states, rad, rad/s, Nm.
    command :
        Commanded torques, Nm.
    external_torque :
        Residual of the momentum observer, Nm.
    contact_force :
        True contact force in simulation, N: a column per robot body, and the columns "sum" and "max".
    safety :
        Changes in the order of time; a state that is only repeated is left out.
    goals :
        Goals in the order of time.
    diagnostics :
        Numbers from the diagnostics, by "<status>/<key>".
    plan_times :
        (n,) when plans take effect, s, in order.
    plans :
        How they were found, in the order of their effect.
    state_sent_ns, command_sent_ns :
        (n,) when joint states and commands were sent, ns since the epoch; in the order of their series.
    answers_ns :
        (n,) from the sending of a joint state to the sending of its command, ns.
    settings :
        By node, what it ran with.
    in_lockstep :
        Whether simulated time waited for the nodes.
    notes :
        What is odd about the messages, one sentence each.
    """

    origin_ns: int
    position: Series
    velocity: Series
    effort: Series
    command: Series
    external_torque: Series
    contact_force: Series
    safety: tuple[Event, ...]
    goals: tuple[Goal, ...]
    diagnostics: Mapping[str, Series]
    plan_times: np.ndarray
    plans: tuple[PlanStatistics, ...]
    state_sent_ns: np.ndarray
    command_sent_ns: np.ndarray
    answers_ns: np.ndarray
    settings: Mapping[str, Mapping[str, Any]]
    in_lockstep: bool
    notes: tuple[str, ...]


def read_signals(bag: BagReader, joint_names: Sequence[str] = JOINT_NAMES, namespace: str = "/") -> EpisodeSignals:
    """Read an episode.

    Parameters
    ----------
    bag :
        The recording.
    joint_names :
        Order of the joints in the series; messages are mapped by name.
    namespace :
        Namespace of the robot's topics.
    """
    prefix = namespace.rstrip("/") + "/"
    joints = tuple(joint_names)
    states = JointStates(("position", "velocity", "effort"), joints)
    commands, torques, contacts = Arrays(len(joints)), JointStates(("effort",), joints), JointStates(("effort",))
    pose_stamps = Stamps()
    safety = _SafetyChanges(bag)
    kept: dict[str, list[RawMessage]] = {
        name: [] for name in ("goal_pose", "diagnostics", "plan/statistics", "settings", "intake/controller")
    }
    handlers: dict[str, Collector | Callable[[RawMessage], None]] = {
        "joint_states": states,
        "effort_controller/commands": commands,
        "external_torque": torques,
        "sim/contacts": contacts,
        "reference/pose": pose_stamps,
        "safety_state": safety.add,
        **{name: messages.append for name, messages in kept.items()},
    }
    read_raw(bag, {prefix + name: handler for name, handler in handlers.items()})

    def decoded(name: str) -> list[BagMessage]:
        pairs = ((raw, bag.decode(raw)) for raw in kept[name])
        return [
            BagMessage(raw.topic, raw.log_time_ns, raw.publish_time_ns, message)
            for raw, message in pairs
            if message is not None
        ]

    state = states.column()
    clock = _Clock(state)
    command, contact = commands.column(), contacts.column()
    state_times = clock.of_stamps(state)
    count = len(joints)
    settings = {message.message.name: read_settings(message.message) for message in decoded("settings")}
    pose_ns = pose_stamps.column().stamp_ns
    torque = torques.column()
    plans = [plan for raw in kept["plan/statistics"] for plan in _plans(clock, *_entries(bag, raw))]
    return EpisodeSignals(
        clock.origin_ns,
        Series(state_times, joints, state.values[:, :count]),
        Series(state_times, joints, state.values[:, count : 2 * count]),
        Series(state_times, joints, state.values[:, 2 * count :]),
        Series(clock.of_receptions(command.log_ns), joints, command.values),
        Series(clock.of_stamps(torque), joints, torque.values),
        Series(clock.of_stamps(contact), contact.names, contact.values),
        safety.changes(clock),
        tuple(_goal(clock, message) for message in decoded("goal_pose")),
        _diagnostics(
            clock.of_receptions(np.array([raw.log_time_ns for raw in kept["diagnostics"]], np.int64)),
            [_entries(bag, raw)[1] for raw in kept["diagnostics"]],
        ),
        (np.sort(pose_ns[pose_ns > 0]) - clock.origin_ns) / NANOSECONDS,
        tuple(sorted(plans, key=lambda plan: plan.time)),
        state.publish_ns,
        command.publish_ns,
        _answers(command, [array_numbers(raw.data, "<i8") for raw in kept["intake/controller"]]),
        settings,
        any(values.get("use_sim_time") is True for values in settings.values()) or prefix + "clock" in bag.topics(),
        _oddities({"joint_states": state, "external_torque": torque, "sim/contacts": contact}, command),
    )


def goal_distance(
    signals: EpisodeSignals,
    flange_positions: Callable[[np.ndarray], np.ndarray],
    period: float = 0.01,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the flange from the goal that is in force; from the first one before it is sent.

    Parameters
    ----------
    signals :
        The episode.
    flange_positions :
        Forward kinematics: joint positions (n, 7) in rad to positions (n, 3) in m, in the frame of the goals.
    period :
        Spacing of the result, s; joint states in between are left out.

    Returns
    -------
    time, distance :
        (n,) in s and (n,) in m; both empty if there is no goal or no joint state.
    """
    time, positions = signals.position.time, signals.position.values
    if not signals.goals or not len(time):
        return np.empty(0), np.empty(0)
    wanted = np.arange(time[0], time[-1] + period / 2, period)
    # A thousandth earlier, so that rounding does not skip a joint state that comes at the very time.
    rows = np.unique(np.clip(np.searchsorted(time, wanted - 1e-3 * period), 0, len(time) - 1))
    rows = rows[np.all(np.isfinite(positions[rows]), axis=1)]
    sent = np.array([goal.time for goal in signals.goals])
    in_force = np.maximum(np.searchsorted(sent, time[rows], side="right") - 1, 0)
    goals = np.array([goal.position for goal in signals.goals])[in_force]
    return time[rows], np.linalg.norm(flange_positions(positions[rows]) - goals, axis=1)


def first_below(time: np.ndarray, values: np.ndarray, limit: float, after: float = 0.0) -> float | None:
    """First time, not before `after`, at which the values are at or below a limit; None if they never are."""
    found = np.flatnonzero((values <= limit) & (time >= after))
    return float(time[found[0]]) if len(found) else None


class _Clock:
    """Places messages on the robot's clock, in s since its first joint state."""

    def __init__(self, states: Column) -> None:
        stamped = states.stamp_ns != 0
        received, stamps = states.log_ns[stamped], states.stamp_ns[stamped]
        if len(stamps):
            self._received_0, self.origin_ns = int(received[0]), int(stamps[0])
        else:
            self._received_0 = self.origin_ns = int(states.log_ns[0]) if len(states) else 0
        self._received = (received - self._received_0) / NANOSECONDS
        self._stamps = (stamps - self.origin_ns) / NANOSECONDS

    def of_stamps(self, column: Column) -> np.ndarray:
        """By the stamps in the headers, or by reception where they are zero."""
        times = (column.stamp_ns - self.origin_ns) / NANOSECONDS
        unstamped = column.stamp_ns == 0
        times[unstamped] = self.of_receptions(column.log_ns[unstamped])
        return times

    def of_receptions(self, log_ns: np.ndarray) -> np.ndarray:
        """By times of reception, ns."""
        received = (log_ns - self._received_0) / NANOSECONDS
        if not len(self._received):
            return received
        inside = np.interp(received, self._received, self._stamps)
        # Outside of the joint states both clocks are taken to run alike.
        return inside + received - np.clip(received, self._received[0], self._received[-1])

    def of_reception(self, log_ns: int) -> float:
        """By one time of reception."""
        return float(self.of_receptions(np.array([log_ns]))[0])


class _SafetyChanges:
    """The messages that tell something new: some senders repeat their state to show that they are alive."""

    def __init__(self, bag: BagReader) -> None:
        self._bag = bag
        self._changes: list[tuple[RawMessage, Any]] = []
        self._last: dict[str, tuple[int, str]] = {}

    def add(self, raw: RawMessage) -> None:
        """Take a message."""
        said = _name_level_message(raw.data)
        if said is not None and self._last.get(said[0]) == said[1:]:
            return
        status = self._bag.decode(raw)
        if status is None:
            return
        state = (_level(status.level), status.message)
        if self._last.get(status.name) != state:
            self._last[status.name] = state
            self._changes.append((raw, status))

    def changes(self, clock: _Clock) -> tuple[Event, ...]:
        """All of them."""
        return tuple(
            Event(
                clock.of_reception(raw.log_time_ns),
                _level(status.level),
                status.name,
                status.message,
                {entry.key: entry.value for entry in status.values},
            )
            for raw, status in self._changes
        )


def _name_level_message(data: bytes) -> tuple[str, int, str] | None:
    """What a serialised DiagnosticStatus begins with; None if it is not plain."""
    try:
        if not data.startswith(PLAIN_CDR):
            return None
        name_at = HEADER + COUNT.size
        message_at = after_string(data, name_at)
        return text_at(data, name_at), data[HEADER], text_at(data, message_at)
    except (struct.error, UnicodeDecodeError):
        return None


def _entries(bag: BagReader, raw: RawMessage) -> tuple[int, Sequence[Status]]:
    """Stamp, ns, and entries of a DiagnosticArray; none if it cannot be read, which the bag's notes tell."""
    try:
        return diagnostic_array(raw.data)
    except ValueError:
        message = bag.decode(raw)
    if message is None:
        return 0, ()
    stamp = message.header.stamp
    entries = [
        Status(
            _level(status.level), status.name, status.message, tuple((item.key, item.value) for item in status.values)
        )
        for status in message.status
    ]
    return stamp.sec * NANOSECONDS + stamp.nanosec, entries


def _plans(clock: _Clock, stamp_ns: int, entries: Sequence[Status]) -> list[PlanStatistics]:
    time = (stamp_ns - clock.origin_ns) / NANOSECONDS
    plans = []
    for status in entries:
        reason = dict(status.values).get("stop reason", status.message)
        plans.append(PlanStatistics(time, reason, dict(_numbers(status))))
    return plans


def _numbers(status: Status) -> Iterator[tuple[str, float]]:
    """The values that are numbers, by their keys."""
    for key, value in status.values:
        try:
            yield key, float(value)
        except ValueError:
            continue


def _answers(commands: Column, batches: Sequence[np.ndarray]) -> np.ndarray:
    """From the sending of each joint state to that of its command, ns, by what the controller says it took in."""
    rows = [batch[1:].reshape(-1, len(COLUMNS)) for batch in batches if len(batch) % len(COLUMNS) == 1]
    if not rows or not commands.sequence.any():
        return np.zeros(0, np.int64)
    taken = np.concatenate(rows)
    taken = taken[taken[:, 0] == Taken.JOINT_STATES]
    # The command that follows has the next number.
    order = np.argsort(commands.sequence, kind="stable")
    numbers = commands.sequence[order]
    at = np.searchsorted(numbers, taken[:, 3] + 1)
    known = at < len(numbers)
    known[known] = numbers[at[known]] == taken[known, 3] + 1
    answers = commands.publish_ns[order][at[known]] - taken[known, 1]
    return answers[(answers >= 0) & (answers < NANOSECONDS)]


def _oddities(columns: Mapping[str, Column], commands: Column) -> tuple[str, ...]:
    notes = [
        f"{name}: {column.refused} messages cannot be read and are left out"
        for name, column in {**columns, "effort_controller/commands": commands}.items()
        if column.refused
    ]
    for name, column in columns.items():
        back = int((np.diff(column.stamp_ns) < 0).sum())
        if back:
            notes.append(f"{name}: {back} stamps are older than the one before; curves follow the stamps")
    states = columns["joint_states"]
    if len(states) and np.isnan(states.values[:, : len(states.names) // 3]).all():
        notes.append(
            f"joint_states: has none of the joints {', '.join(dict.fromkeys(states.names))}: is it another robot's?"
        )
    return tuple(notes)


def _level(level: Any) -> int:
    """The level as a number; it is a byte in the definition."""
    return level[0] if isinstance(level, bytes) else int(level)


def _goal(clock: _Clock, message: BagMessage) -> Goal:
    position, orientation = message.message.pose.position, message.message.pose.orientation
    return Goal(
        clock.of_reception(message.log_time_ns),
        message.message.header.frame_id,
        np.array([position.x, position.y, position.z]),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w]),
    )


def _diagnostics(times: np.ndarray, messages: Sequence[Sequence[Status]]) -> dict[str, Series]:
    """Numbers by '<status>/<key>', of messages at some times, s."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for time, entries in zip(times.tolist(), messages, strict=True):
        for status in entries:
            for key, number in _numbers(status):
                column = found.setdefault(f"{status.name}/{key}", ([], []))
                column[0].append(time)
                column[1].append(number)
    return {key: Series(np.array(when), (key,), np.array(numbers)[:, None]) for key, (when, numbers) in found.items()}
