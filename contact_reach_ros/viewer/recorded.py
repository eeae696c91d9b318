"""A bag as shown on the page: any of its moments, and its events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import tip_positions
from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.recorded_arm import arm_of_bag
from contact_reach_ros.bags.signals import EpisodeSignals, Series, read_signals
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.viewer.frame import Frame, SafetyStatus
from contact_reach_ros.viewer.history import SPAN, joint_labels, quantities, thinned
from contact_reach_ros.viewer.readings import ANY_MATERIAL, safety_status
from contact_reach_ros.viewer.recorded_events import contact_events, goal_events, speaker, stop_events

_PICTURES, _OBSTACLES, _SAFETY = "/plan/markers", "/obstacles", "/safety_state"
"""Topics whose messages are read from the bag only when their moment is shown."""

_SAMPLES = 0.02
"""Time between the points of a curve, s: even the fastest plotted quantities are thinned to this rate."""
_ROUND_TRIPS = ("p50", "p99")

T = TypeVar("T")


class Recording:
    """A bag, opened to show any of its moments; raises `BagError` if the bag cannot be read or holds no joint states.

    Parameters
    ----------
    path
        The bag.
    arm
        The arm if the bag records none.

    Attributes
    ----------
    arm
        The recorded arm, with its tool.
    duration
        Time from the first to the last joint state, s.
    ticks
        (n,) times of the joint states since the first, s, increasing.
    events
        Events, ordered by time.
    """

    def __init__(self, path: Path, arm: Arm) -> None:
        self.path = path
        self._reader = BagReader(path, of_stack=True)
        self.arm = arm_of_bag(self._reader)
        if self.arm.name != arm.name:
            raise BagError(f"bag '{path}' is of arm '{self.arm.name}', the page of '{arm.name}': view it with --arm")
        self._read_obstacles = ObstacleMarkerReader(self.arm.base_frame, ANY_MATERIAL).read
        signals = read_signals(self._reader, self.arm.joint_names)
        position = signals.position
        # States with unknown joints, and repeated ones, are not moments to look at.
        good = np.asarray(np.isfinite(position.values).all(axis=1))
        good[1:] &= position.time[1:] > np.maximum.accumulate(position.time)[:-1]
        if not good.any():
            raise BagError(f"{self.path}: holds no joint states of the arm; record joint_states")
        begin = float(position.time[good][0])
        self.ticks, self._q = position.time[good] - begin, position.values[good]
        self.duration = float(self.ticks[-1])
        self._received = signals.state_received_ns[good]
        self._torque, self._force = signals.external_torque.since(begin), signals.contact_force.since(begin)
        self._link_forces = np.stack([self._force.column(link) for link in self.arm.contact_links], axis=1)
        self._goals = signals.goals.since(begin)
        spoken = sorted(((raw.log_time_ns, speaker(raw.data)) for raw in self._raw(_SAFETY)), key=itemgetter(0))
        self._speakers = {
            name: np.flatnonzero([other == name for _, other in spoken])
            for name in sorted({name for _, name in spoken})
        }
        # The files of a bag may overlap.
        self._messages = {topic: np.sort(self._reception_times(topic)) for topic in (_PICTURES, _OBSTACLES)}
        self._messages[_SAFETY] = np.array([received_ns for received_ns, _ in spoken], np.int64)
        self._kept: dict[str, tuple[int, Any]] = {}
        self.events = tuple(
            sorted(
                [
                    *goal_events(self._goals, "goal", "goal"),
                    *goal_events(signals.refused_goals.since(begin), "refused", "refused goal"),
                    *stop_events(signals.safety, begin),
                    *contact_events(self._force, signals.safety, begin),
                ]
            )
        )
        self._table = self._make_table(signals, begin)

    def frame(self, time: float) -> Frame:
        """The moment `time` s after the first joint state."""
        tick = self.tick(time)
        until_ns = int(self._received[tick])
        torque, contact, goal = (self._row(series.time, time) for series in (self._torque, self._force, self._goals))
        return Frame(
            time=float(self.ticks[tick]),
            q=self._q[tick],
            external_torque=self._torque.values[torque] if torque >= 0 else None,
            obstacles=self._newest(_OBSTACLES, until_ns, self._read_obstacles),
            plan=self._newest(_PICTURES, until_ns, read_plan),
            forces=dict(zip(self.arm.contact_links, self._link_forces[contact].tolist(), strict=True))
            if contact >= 0
            else {},
            goal=self._goals.values[goal] if goal >= 0 else None,
            safety=self._safety_at(until_ns),
        )

    def tick(self, time: float) -> int:
        """Index of the last joint state at or before a time, s."""
        return max(self._row(self.ticks, time), 0)

    def table(self, time: float) -> Array:
        """`quantities` over the last `SPAN` seconds before a time, as `History.table`."""
        first, last = np.searchsorted(self._table[:, 0], [time - SPAN, time + 1e-9])
        return thinned(self._table[first:last])

    @property
    def first_goal(self) -> float:
        """When the first goal was sent, s; 0 without one."""
        return next((event.time for event in self.events if event.kind == "goal"), 0.0)

    def next_contact(self, time: float) -> float | None:
        """Start of the first contact after a time, s; None without any."""
        return next((event.time for event in self.events if event.kind == "contact" and event.time > time + 1e-6), None)

    def _raw(self, topic: str, start_ns: int = 0) -> Iterator[RawMessage]:
        """The messages of a topic, which the bag may lack."""
        return self._reader.raw_messages([topic] if topic in self._reader.topics() else [], start_ns)

    def _reception_times(self, topic: str) -> NDArray[np.int64]:
        return self._reader.reception_times(topic) if topic in self._reader.topics() else np.zeros(0, np.int64)

    def _row(self, times: Array, time: float) -> int:
        return int(np.searchsorted(times, time + 1e-9, side="right")) - 1

    def _message(self, topic: str, row: int) -> Any:
        """A message of a topic, by its place among those by time of reception, of obstacles its bytes; None without."""
        times = self._messages[topic]
        time_ns = int(times[row])
        same = (raw for raw in self._raw(topic, time_ns) if raw.log_time_ns == time_ns)
        raw = next(islice(same, row - int(np.searchsorted(times, time_ns)), None), None)
        if raw is None:
            return None
        return raw.data if topic == _OBSTACLES else self._reader.decode(raw)

    def _last_row(self, topic: str, until_ns: int) -> int:
        """Row of the last message received until `until_ns`; -1 if there is none."""
        return int(np.searchsorted(self._messages[topic], until_ns, side="right")) - 1

    def _newest(self, topic: str, until_ns: int, read: Callable[[Any], T]) -> T | None:
        row = self._last_row(topic, until_ns)
        return self._kept_or_read(topic, topic, row, read) if row >= 0 else None

    def _kept_or_read(self, key: str, topic: str, row: int, read: Callable[[Any], T]) -> T | None:
        """Read a message, keeping the last one of each key; None for an invalid one."""
        kept = self._kept.get(key)
        if kept is None or kept[0] != row:
            message = self._message(topic, row)
            try:
                kept = row, None if message is None else read(message)
            except InputError:
                kept = row, None
            self._kept[key] = kept
        value: T | None = kept[1]
        return value

    def _safety_at(self, until_ns: int) -> dict[str, SafetyStatus]:
        last = self._last_row(_SAFETY, until_ns)
        found = {}
        for name, rows in self._speakers.items():
            place = int(np.searchsorted(rows, last, side="right")) - 1
            if place >= 0:
                status = self._kept_or_read(f"{_SAFETY} {name}", _SAFETY, int(rows[place]), self._read_status)
                if status is not None:
                    found[name] = status
        return found

    def _read_status(self, message: Any) -> SafetyStatus:
        return safety_status(message, self.arm)

    def _make_table(self, signals: EpisodeSignals, begin: float) -> Array:
        """All plotted quantities at equidistant times."""
        times = np.arange(0.0, self.duration + 0.5 * _SAMPLES, _SAMPLES)
        names = quantities(self.arm.n)
        table = np.full((len(times), len(names)), np.nan)
        columns = dict(zip(names, table.T, strict=True))
        columns["time"][:] = times
        goal = np.searchsorted(self._goals.time, times, side="right") - 1
        known = np.flatnonzero(goal >= 0)
        if len(known):
            ticks = np.searchsorted(self.ticks, times[known] + 1e-9, side="right") - 1
            flange = tip_positions(self.arm, self._q[ticks])
            columns["distance"][known] = 1000.0 * np.linalg.norm(flange - self._goals.values[goal[known]], axis=1)
        _peaks(columns["force"], times, Series(self._force.time, ("max",), self._force.column("max")[:, None]))
        if len(self._torque.time):
            rows = np.searchsorted(self._torque.time, times + 1e-9, side="right") - 1
            for joint, name in enumerate(joint_labels(self.arm.n)):
                columns[name][:] = np.where(rows >= 0, self._torque.values[rows, joint], np.nan)
        if len(signals.plan_times):
            effects = signals.plan_times - begin
            rows = np.searchsorted(effects, times + 1e-9, side="right") - 1
            columns["plan age"][:] = np.where(rows >= 0, 1000.0 * (times - effects[rows]), np.nan)
        for name in _ROUND_TRIPS:
            measured = signals.diagnostics.get(f"driver/round trip {name} us")
            if measured is not None:
                _peaks(columns[f"round trip {name}"], times, measured.since(begin))
        return table


def _peaks(column: Array, times: Array, series: Series) -> None:
    """Enter the largest value of a series up to each of the times, from the one before; the last one where none is."""
    place = np.searchsorted(times, series.time)
    inside = place < len(times)
    np.fmax.at(column, place[inside], series.values[inside, 0])
    known = np.maximum.accumulate(np.where(np.isfinite(column), np.arange(len(column)), -1))
    column[:] = np.where(known >= 0, column[known], np.nan)
