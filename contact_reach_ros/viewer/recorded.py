"""A bag as shown on the page: any of its moments, its events, and its plotted quantities."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm import Arm, Array
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.signals import EpisodeSignals, Series, arm_of_bag, goal_distance, read_signals
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_reader import PlanPicture, read_plan
from contact_reach_ros.messages.safety_state import WARN, SafetyState
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.plots import SPAN

_PICTURES, _OBSTACLES = "/plan/markers", "/obstacles"
"""Topics with large messages, which are read from the bag when their moment is shown."""
_SAMPLES = 0.05
"""Time between the points of a curve, s: 400 of them over the span of a plot."""
_ROUNDING = 1e-9
"""Difference of two times that are equal except for rounding, s."""
_CONTACT_FORCE = 0.5
"""True force that counts as a contact, N."""
_STREAM_S = 1.0
"""Time to the goal before within which a goal is no event of its own, s."""
_LONGEST = 86400.0
"""Time from the middle joint state from which on a stamp is wrong, s."""
_CONTACT_PAUSE = 0.3
"""Time without contact after which the next contact is a new one, s."""

T = TypeVar("T")


class Event(NamedTuple):
    """Something worth jumping to: time, s, a kind, and a description.

    Kinds are 'goal', 'refused' (a goal without a plan), 'contact', 'stop' and 'released'.
    """

    time: float
    kind: str
    text: str


class Recording:
    """A bag, opened to show any of its moments; raises `BagError` if the bag cannot be read or holds no joint states.

    Attributes
    ----------
    arm
        The recorded arm, with its tool.
    duration
        Time of the last joint state, s since the first.
    ticks
        (n,) times of the joint states since the first, s, increasing.
    events
        Events, ordered by time.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = BagReader(path, of_stack=True)
        self.arm = arm_of_bag(self._reader)
        self._obstacles = ObstacleMarkerReader(self.arm.base_frame)
        self._signals = signals = read_signals(self._reader, self.arm)
        position = signals.position
        # States with unknown joints, and repeated states, are not moments to look at.
        middle = np.median(position.time) if len(position.time) else 0.0
        near = np.abs(position.time - middle) < _LONGEST
        good = np.flatnonzero(near & np.isfinite(position.values).all(axis=1))
        good = good[_increasing(position.time[good])]
        if not len(good):
            raise BagError(f"{self.path}: holds no joint states of the arm; record joint_states")
        self.ticks, self._q = position.time[good], position.values[good]
        self.duration = float(self.ticks[-1])
        if self.duration < 0.0:
            raise BagError(
                f"{self.path}: the first joint state has a later stamp than all others, as by another clock: record "
                "without it; contact-reach report reads the bag"
            )
        force = signals.contact_force
        self._link_forces = np.stack([force.column(link) for link in self.arm.contact_links], axis=1)
        self._received_ns = {topic: self._reception_times(topic) for topic in (_PICTURES, _OBSTACLES)}
        self._message_times = {topic: signals.clock.of_receptions(ns) for topic, ns in self._received_ns.items()}
        self._kept: dict[str, tuple[int, Any]] = {}
        self._safety = sorted(signals.safety_states, key=attrgetter("time"))
        self._safety_times = np.array([state.time for state in self._safety])
        found = [
            *_goal_events(signals.goals, "goal", "goal"),
            *_goal_events(signals.refused_goals, "refused", "refused goal"),
            *_stop_events(signals.safety),
            *_contact_events(signals),
        ]
        self.events = tuple(sorted(found))
        self._table = _table(self.arm, signals, self.duration)

    def frame(self, time: float) -> Frame:
        """The moment `time` s after the first joint state."""
        signals, tick = self._signals, self.tick(time)
        torque = _row(signals.external_torque.time, time)
        force = _row(signals.contact_force.time, time)
        goal = _row(signals.goals.time, time)
        return Frame(
            time=float(self.ticks[tick]),
            q=self._q[tick],
            external_torque=signals.external_torque.values[torque] if torque >= 0 else None,
            obstacles=self._newest(_OBSTACLES, time, lambda raw: self._obstacles.read(raw.data)),
            plan=self._newest(_PICTURES, time, self._read_plan),
            forces=dict(zip(self.arm.contact_links, self._link_forces[force].tolist(), strict=True))
            if force >= 0
            else {},
            goal=signals.goals.values[goal] if goal >= 0 else None,
            safety={state.name: state for state in self._safety[: _row(self._safety_times, time) + 1]},
        )

    def tick(self, time: float) -> int:
        """Index of the last joint state at or before a time, s."""
        return max(_row(self.ticks, time), 0)

    def table(self, time: float) -> Array:
        """`quantities` over the last `SPAN` seconds before a time, as `History.table`."""
        first, last = np.searchsorted(self._table[:, 0], [time - SPAN, time + _ROUNDING])
        return self._table[first:last]

    def _reception_times(self, topic: str) -> np.ndarray:
        """Times (n,), ns, in order: the files of a bag may overlap."""
        if topic not in self._reader.topics:
            return np.zeros(0, np.int64)
        return np.sort(np.array([raw.log_time_ns for raw in self._reader.raw_messages([topic])], np.int64))

    def _newest(self, topic: str, time: float, read: Callable[[RawMessage], T | None]) -> T | None:
        """Read the last message of a topic up to a time, s, and keep it; None without any, or for an invalid one."""
        row = _row(self._message_times[topic], time)
        if row < 0:
            return None
        kept = self._kept.get(topic)
        if kept is None or kept[0] != row:
            try:
                kept = row, read(next(self._reader.raw_messages([topic], int(self._received_ns[topic][row]))))
            except InputError:
                kept = row, None
            self._kept[topic] = kept
        value: T | None = kept[1]
        return value

    def _read_plan(self, raw: RawMessage) -> PlanPicture | None:
        """The plan in a message; None if it cannot be decoded."""
        message = self._reader.decode(raw)
        return None if message is None else read_plan(message)


def _increasing(times: Array) -> NDArray[np.intp]:
    """Places of times (n,) that are later than all before, or earlier than all behind, whichever are more."""
    before = np.append(-np.inf, np.maximum.accumulate(times))[:-1]
    behind = np.append(np.minimum.accumulate(times[::-1])[::-1], np.inf)[1:]
    return max(np.flatnonzero(times > before), np.flatnonzero(times < behind), key=len)


def _row(times: Array, time: float) -> int:
    """Index of the last of the times, s, up to a time; -1 if there is none."""
    return int(np.searchsorted(times, time + _ROUNDING, side="right")) - 1


def _goal_events(goals: Series, kind: str, words: str) -> Iterator[Event]:
    """Goals, of those that follow each other soon only the first."""
    last = -np.inf
    for time, position in zip(goals.time.tolist(), goals.values, strict=True):
        is_next, last = time - last < _STREAM_S, time
        if not is_next:
            yield Event(time, kind, f"{words} {np.round(position, 3).tolist()} m")


def _stop_events(states: Sequence[SafetyState]) -> Iterator[Event]:
    """Stops and releases of each node."""
    stopped: dict[str, bool] = {}
    for state in states:
        if state.is_stop != stopped.get(state.name, False):
            stopped[state.name] = state.is_stop
            yield Event(state.time, "stop" if state.is_stop else "released", f"{state.name}: {state.message}")


def _contact_events(signals: EpisodeSignals) -> Iterator[Event]:
    """Beginnings of contacts by true forces; without any forces, by safety states."""
    forces = signals.contact_force
    if len(forces.time):
        touched = forces.time[forces.column("max") >= _CONTACT_FORCE]
    else:
        touched = np.array([state.time for state in signals.safety if state.level == WARN])
    starts = touched[np.append(True, np.diff(touched) > _CONTACT_PAUSE)[: len(touched)]]
    for time in starts.tolist():
        yield Event(time, "contact", "contact begins")


def _table(arm: Arm, signals: EpisodeSignals, duration: float) -> Array:
    """All plotted quantities at equidistant times: (n, `quantities`)."""
    times = np.arange(0.0, duration + 0.5 * _SAMPLES, _SAMPLES)
    distance = _latest(times, goal_distance(signals, arm, _SAMPLES))[:, 0]
    first_goal = signals.goals.time[0] if len(signals.goals.time) else np.inf
    return np.column_stack(
        [
            times,
            np.where(times + _ROUNDING < first_goal, np.nan, 1000.0 * distance),
            _peaks(times, signals.contact_force),
            _latest(times, signals.external_torque),
        ]
    )


def _latest(times: Array, series: Series) -> Array:
    """Values (n, k) of a series at or before each of the times (n,); NaN before the first."""
    rows = np.searchsorted(series.time, times + _ROUNDING, side="right") - 1
    values = np.vstack([series.values, np.full((1, series.values.shape[1]), np.nan)])
    return values[rows]


def _peaks(times: Array, forces: Series) -> Array:
    """Largest force, N, since the one before of each of the times (n,); where there is none, the last one."""
    ends = np.searchsorted(forces.time, times + _ROUNDING, side="right")
    starts = np.append(0, np.minimum(ends[:-1], ends[1:] - 1))
    values = forces.column("max")
    return np.array([values[start:end].max() if end else np.nan for start, end in zip(starts, ends, strict=True)])
