"""A bag as shown on the page: any of its moments, and its events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.kinematics import tip_positions
from contact_reach_ros.arrays import Array
from contact_reach_ros.bags.columns import JointStates, Stamps, read_raw
from contact_reach_ros.bags.goals import pursued
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.recorded_arm import arm_of_bag
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, SafetyStatus
from contact_reach_ros.viewer.history import SPAN, joint_labels, quantities, thinned
from contact_reach_ros.viewer.readings import ANY_MATERIAL, goal_position, named_numbers, planned_goal, safety_status
from contact_reach_ros.viewer.recorded_events import (
    Event,
    Reported,
    contact_events,
    goal_events,
    read_reported,
    stop_events,
)

Times = NDArray[np.int64]

_STATES, _TORQUES, _CONTACTS = "/joint_states", "/external_torque", "/sim/contacts"
_PLANS, _PICTURES, _OBSTACLES = "/reference/pose", "/plan/markers", "/obstacles"
_GOALS, _SAFETY, _NUMBERS, _STATISTICS = "/goal_pose", "/safety_state", "/diagnostics", "/plan/statistics"
_ASKED_FOR = (_PICTURES, _OBSTACLES, _SAFETY)
"""Topics whose messages are read from the bag only when their moment is shown."""

_SAMPLES = 0.02
"""Time between the points of a curve, s: even the fastest plotted quantities are thinned to this rate."""
_ROUND_TRIP = b"round trip"

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
        self._read_obstacles = ObstacleMarkerReader(arm.base_frame, ANY_MATERIAL).read
        self._reader = BagReader(path, of_stack=True)
        self.arm = arm_of_bag(self._reader)
        if self.arm.name != arm.name:
            raise BagError(f"bag '{path}' is of arm '{self.arm.name}', the page of '{arm.name}': view it with --arm")
        self._read()
        self.events = self._find_events()
        self._table = self._make_table()

    @property
    def start(self) -> float:
        """Stamp of the first joint state, s."""
        return float(self._start_ns / NANOSECONDS)

    def frame(self, time: float) -> Frame:
        """The moment `time` s after the first joint state."""
        tick = self.tick(time)
        until_ns = int(self._received[tick])
        torque = self._row(self._torque_times, time)
        contact = self._row(self._contact_times, time)
        goal = self._row(self._goals[0], time)
        return Frame(
            time=float(self.ticks[tick]),
            q=self._q[tick],
            external_torque=self._torques[torque] if torque >= 0 else None,
            obstacles=self._newest(_OBSTACLES, until_ns, self._read_obstacles),
            plan=self._newest(_PICTURES, until_ns, read_plan),
            forces=dict(zip(self.arm.contact_links, self._forces[contact].tolist(), strict=True))
            if contact >= 0
            else {},
            goal=self._goals[1][goal] if goal >= 0 else None,
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

    def _read(self) -> None:
        columns = {
            _STATES: JointStates(["position"], self.arm.joint_names),
            _TORQUES: JointStates(["effort"], self.arm.joint_names),
            _CONTACTS: JointStates(["effort"], (*self.arm.contact_links, "max")),
            _PLANS: Stamps(),
        }
        received: dict[str, list[int]] = {topic: [] for topic in _ASKED_FOR}
        reported: list[Reported] = []
        goals: list[tuple[int, Array]] = []
        self._numbers: list[tuple[int, Mapping[str, float]]] = []
        planned: list[Array] = []

        def note(raw: RawMessage) -> None:
            received[raw.topic].append(raw.log_time_ns)
            if raw.topic == _SAFETY:
                reported.append(read_reported(raw.data))

        def take(raw: RawMessage, read: Callable[[Any], T]) -> list[T]:
            """What is read of a message; nothing of an invalid one."""
            message = self._reader.decode(raw)
            with suppress(InputError):
                return [] if message is None else [read(message)]
            return []

        def take_goal(raw: RawMessage) -> None:
            goals.extend((raw.log_time_ns, goal) for goal in take(raw, goal_position))

        def take_planned(raw: RawMessage) -> None:
            planned.extend(goal for goal in take(raw, planned_goal) if goal is not None)

        def take_numbers(raw: RawMessage) -> None:
            # There are thousands of diagnostics, and only the driver's contain the round trip.
            if _ROUND_TRIP in raw.data:
                self._numbers.extend((raw.log_time_ns, found) for found in take(raw, named_numbers))

        others = {_GOALS: take_goal, _STATISTICS: take_planned, _NUMBERS: take_numbers}
        read_raw(self._reader, {**columns, **dict.fromkeys(_ASKED_FOR, note), **others})
        states, torques, contacts = (columns[topic].column() for topic in (_STATES, _TORQUES, _CONTACTS))
        # States with unknown joints, and repeated ones, are not moments to look at.
        good = np.asarray(np.isfinite(states.values).all(axis=1))
        good[1:] &= states.stamp_ns[1:] > np.maximum.accumulate(states.stamp_ns)[:-1]
        if not good.any():
            raise BagError(f"{self.path}: holds no joint states of the arm; record joint_states")
        self._received, stamps, self._q = states.log_ns[good], states.stamp_ns[good], states.values[good]
        self._start_ns = int(stamps[0])
        self.ticks = (stamps - self._start_ns) / NANOSECONDS
        self.duration = float(self.ticks[-1])
        self._torque_times, self._torques = (torques.stamp_ns - self._start_ns) / NANOSECONDS, torques.values
        self._contact_times = (contacts.stamp_ns - self._start_ns) / NANOSECONDS
        self._forces, self._largest = contacts.values[:, :-1], contacts.values[:, -1]
        self._plan_times = (np.sort(columns[_PLANS].column().stamp_ns) - self._start_ns) / NANOSECONDS
        # The files of a bag may overlap.
        self._messages = {topic: np.sort(np.array(times, np.int64)) for topic, times in received.items()}
        self._reported = [reported[row] for row in np.argsort(received[_SAFETY], kind="stable")]
        times = self._time_of(np.array([received_ns for received_ns, _ in goals], np.int64))
        positions = np.array([position for _, position in goals]).reshape(-1, 3)
        accepted = pursued(positions, planned)
        self._goals = times[accepted], positions[accepted]
        self._refused = times[~accepted], positions[~accepted]
        self._speakers = {
            name: np.array([row for row, entry in enumerate(self._reported) if entry.name == name], np.int64)
            for name in {entry.name for entry in self._reported}
        }
        self._kept: dict[str, tuple[int, Any]] = {}

    def _time_of(self, received_ns: int | Times) -> Array:
        """Times on the robot's clock, s, at times of reception."""
        return np.asarray(np.interp(received_ns, self._received, self.ticks))

    def _row(self, times: Array, time: float) -> int:
        return int(np.searchsorted(times, time + 1e-9, side="right")) - 1

    def _message(self, topic: str, row: int) -> Any:
        """A message of a topic, by its place among those by time of reception; None if it cannot be decoded."""
        times = self._messages[topic]
        time_ns = int(times[row])
        same = (raw for raw in self._reader.raw_messages([topic], time_ns) if raw.log_time_ns == time_ns)
        raw = next(islice(same, row - int(np.searchsorted(times, time_ns)), None), None)
        return None if raw is None else self._reader.decode(raw)

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
        for name, rows in sorted(self._speakers.items()):
            place = int(np.searchsorted(rows, last, side="right")) - 1
            if place >= 0:
                status = self._kept_or_read(f"{_SAFETY} {name}", _SAFETY, int(rows[place]), self._read_status)
                if status is not None:
                    found[name] = status
        return found

    def _read_status(self, message: Any) -> SafetyStatus:
        return safety_status(message, self.arm)

    def _find_events(self) -> tuple[Event, ...]:
        reported_at = self._time_of(self._messages[_SAFETY])
        return tuple(
            sorted(
                [
                    *goal_events(*self._goals, "goal", "goal"),
                    *goal_events(*self._refused, "refused", "refused goal"),
                    *stop_events(reported_at, self._reported),
                    *contact_events(self._contact_times, self._largest, reported_at, self._reported),
                ]
            )
        )

    def _make_table(self) -> Array:
        """All plotted quantities at equidistant times."""
        times = np.arange(0.0, self.duration + 0.5 * _SAMPLES, _SAMPLES)
        names = quantities(self.arm.n)
        table = np.full((len(times), len(names)), np.nan)
        columns = dict(zip(names, table.T, strict=True))
        columns["time"][:] = times
        goal = np.searchsorted(self._goals[0], times, side="right") - 1
        known = np.flatnonzero(goal >= 0)
        if len(known):
            ticks = np.searchsorted(self.ticks, times[known] + 1e-9, side="right") - 1
            flange = tip_positions(self.arm, self._q[ticks])
            columns["distance"][known] = 1000.0 * np.linalg.norm(flange - self._goals[1][goal[known]], axis=1)
        place = np.searchsorted(times, self._contact_times)
        inside = place < len(times)
        np.fmax.at(columns["force"], place[inside], self._largest[inside])
        _hold(columns["force"])
        if len(self._torque_times):
            rows = np.searchsorted(self._torque_times, times + 1e-9, side="right") - 1
            for joint, name in enumerate(joint_labels(self.arm.n)):
                columns[name][:] = np.where(rows >= 0, self._torques[rows, joint], np.nan)
        if len(self._plan_times):
            rows = np.searchsorted(self._plan_times, times + 1e-9, side="right") - 1
            columns["plan age"][:] = np.where(rows >= 0, 1000.0 * (times - self._plan_times[rows]), np.nan)
        received = np.array([received_ns for received_ns, _ in self._numbers], np.int64)
        places = np.searchsorted(times, self._time_of(received)).tolist()
        for at, (_, numbers) in zip(places, self._numbers, strict=True):
            for name in ("p50", "p99"):
                if at < len(times) and f"driver/round trip {name} us" in numbers:
                    columns[f"round trip {name}"][at] = numbers[f"driver/round trip {name} us"]
        for name in ("p50", "p99"):
            _hold(columns[f"round trip {name}"])
        return table


def _hold(values: Array) -> None:
    """Fill gaps with the last known value."""
    known = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    values[:] = np.where(known >= 0, values[known], np.nan)
