"""Time series of an episode, read from a bag.

Times are seconds of the robot's own clock since its first joint state: the stamps of joint states, torques and
contacts are on that clock. Messages without a stamp are placed on it through their time of reception, compared with
those of the joint states; so an episode in lockstep, whose clock is not that of the wall, comes out right as well.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from contact_reach_ros.recording.bag_reader import BagMessage, BagReader
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

    Raises
    ------
    BagError
        If the bag is damaged.
    """
    prefix = namespace.rstrip("/") + "/"
    handlers = ("joint_states", "effort_controller/commands", "external_torque", "sim/contacts", "safety_state")
    names = {prefix + name: name for name in (*handlers, "goal_pose", "diagnostics")}
    received: dict[str, list[BagMessage]] = {name: [] for name in names.values()}
    for message in bag.messages([name for name in names if name in bag.topics()]):
        received[names[message.topic]].append(message)

    clock = _Clock(received["joint_states"])
    joints = tuple(joint_names)
    states = received["joint_states"]
    torques = received["external_torque"]
    return EpisodeSignals(
        clock.origin_ns,
        _joint_series(clock, states, joints, "position"),
        _joint_series(clock, states, joints, "velocity"),
        _joint_series(clock, states, joints, "effort"),
        _command_series(clock, received["effort_controller/commands"], joints),
        _joint_series(clock, torques, joints, "effort"),
        _joint_series(clock, received["sim/contacts"], _all_names(received["sim/contacts"]), "effort"),
        _changes(clock, received["safety_state"]),
        tuple(_goal(clock, message) for message in received["goal_pose"]),
        _diagnostics(clock, received["diagnostics"]),
    )


def goal_distance(
    signals: EpisodeSignals,
    flange_position: Callable[[np.ndarray], np.ndarray],
    period: float = 0.01,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the flange from the goal that is in force; from the first one before it is sent.

    Parameters
    ----------
    signals :
        The episode.
    flange_position :
        Forward kinematics: joint positions (7,) in rad to the position (3,) in m, in the frame of the goals.
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
    reached = np.array([flange_position(q) for q in positions[rows]]).reshape(-1, 3)
    return time[rows], np.linalg.norm(reached - goals, axis=1)


def first_below(time: np.ndarray, values: np.ndarray, limit: float, after: float = 0.0) -> float | None:
    """First time, not before `after`, at which the values are at or below a limit; None if they never are."""
    found = np.flatnonzero((values <= limit) & (time >= after))
    return float(time[found[0]]) if len(found) else None


class _Clock:
    """Places messages on the robot's clock, in s since its first joint state."""

    def __init__(self, joint_states: Sequence[BagMessage]) -> None:
        pairs = [(state.log_time_ns, _stamp_ns(state)) for state in joint_states]
        stamped = [(received, stamp) for received, stamp in pairs if stamp]
        self._received_0 = stamped[0][0] if stamped else (pairs[0][0] if pairs else 0)
        self.origin_ns = stamped[0][1] if stamped else self._received_0
        offsets = np.array(stamped, dtype=np.int64).reshape(-1, 2) - (self._received_0, self.origin_ns)
        self._received, self._stamps = offsets.T / NANOSECONDS

    def of_stamp(self, message: BagMessage) -> float:
        """By the stamp in its header, or by reception where that is zero."""
        stamp = _stamp_ns(message)
        return (stamp - self.origin_ns) / NANOSECONDS if stamp else self.of_reception(message)

    def of_reception(self, message: BagMessage) -> float:
        """By its time of reception."""
        received = (message.log_time_ns - self._received_0) / NANOSECONDS
        if not len(self._received):
            return received
        inside = float(np.interp(received, self._received, self._stamps))
        # Outside of the joint states both clocks are taken to run alike.
        return inside + received - float(np.clip(received, self._received[0], self._received[-1]))


def _stamp_ns(message: BagMessage) -> int:
    stamp = message.message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec


def _all_names(messages: Sequence[BagMessage]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for message in messages for name in message.message.name))


def _joint_series(clock: _Clock, messages: Sequence[BagMessage], names: tuple[str, ...], field: str) -> Series:
    """One field of JointState messages, mapped by name."""
    columns: dict[tuple[str, ...], tuple[list[int], list[int]]] = {}
    values = np.full((len(messages), len(names)), np.nan)
    for row, message in enumerate(messages):
        given = tuple(message.message.name)
        if given not in columns:
            shared = [name for name in names if name in given]
            columns[given] = [names.index(name) for name in shared], [given.index(name) for name in shared]
        into, source = columns[given]
        numbers = getattr(message.message, field)
        if len(numbers) == len(given):
            values[row, into] = numbers[source]
    return Series(np.array([clock.of_stamp(message) for message in messages]), names, values)


def _command_series(clock: _Clock, messages: Sequence[BagMessage], names: tuple[str, ...]) -> Series:
    values = np.full((len(messages), len(names)), np.nan)
    for row, message in enumerate(messages):
        if len(message.message.data) == len(names):
            values[row] = message.message.data
    return Series(np.array([clock.of_reception(message) for message in messages]), names, values)


def _changes(clock: _Clock, messages: Sequence[BagMessage]) -> tuple[Event, ...]:
    """The messages that tell something new: some senders repeat their state to show that they are alive."""
    changes: list[Event] = []
    last: dict[str, tuple[int, str]] = {}
    for message in messages:
        status = message.message
        state = (_level(status.level), status.message)
        if last.get(status.name) != state:
            last[status.name] = state
            values = {entry.key: entry.value for entry in status.values}
            changes.append(Event(clock.of_reception(message), state[0], status.name, status.message, values))
    return tuple(changes)


def _level(level: Any) -> int:
    """The level as a number; it is a byte in the definition."""
    return level[0] if isinstance(level, bytes) else int(level)


def _goal(clock: _Clock, message: BagMessage) -> Goal:
    position, orientation = message.message.pose.position, message.message.pose.orientation
    return Goal(
        clock.of_reception(message),
        message.message.header.frame_id,
        np.array([position.x, position.y, position.z]),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w]),
    )


def _diagnostics(clock: _Clock, messages: Sequence[BagMessage]) -> dict[str, Series]:
    found: dict[str, list[tuple[float, float]]] = {}
    for message in messages:
        time = clock.of_reception(message)
        for status in message.message.status:
            for entry in status.values:
                try:
                    number = float(entry.value)
                except ValueError:
                    continue
                found.setdefault(f"{status.name}/{entry.key}", []).append((time, number))
    return {key: Series(np.array(pairs)[:, 0], (key,), np.array(pairs)[:, 1:]) for key, pairs in found.items()}
