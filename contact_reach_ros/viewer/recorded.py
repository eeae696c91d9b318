"""A bag as the page shows it: any moment of it, and what happened when."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.cdr import after_string, text_at
from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.columns import JointStates, Stamps
from contact_reach_ros.recording.index import BagIndex, Place, UnindexedBag
from contact_reach_ros.recording.mcap_chunks import Block
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import flange_positions
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, Level, PlanPicture, Status
from contact_reach_ros.viewer.history import JOINTS, QUANTITIES, SPAN, thinned

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_STATES, _TORQUES, _CONTACTS = "/joint_states", "/external_torque", "/sim/contacts"
_PLANS, _PICTURES, _OBSTACLES = "/reference/pose", "/plan/markers", "/obstacles"
_GOALS, _SAFETY, _NUMBERS = "/goal_pose", "/safety_state", "/diagnostics"
_ASKED_FOR = (_PICTURES, _OBSTACLES, _GOALS, _SAFETY, _NUMBERS)

_SAMPLES = 0.02
"""Time between the points of a curve, s: the rate of the fastest plotted quantities is thinned to that anyway."""
_CONTACT_FORCE = 0.5
"""True force that counts as a contact, N."""
_CONTACT_PAUSE = 0.3
"""Time without a contact after which the next is another one, s."""
_ROUND_TRIP = b"round trip"

_LINKS = tuple(iiwa14.LINK_NAMES[capsule.link - 1] for capsule in iiwa14.CAPSULES)

T = TypeVar("T")


class Decoders(NamedTuple):
    """What turns serialised messages into what they say; each raises `InputError` for bytes that say nothing."""

    obstacles: Callable[[bytes], Spheres]
    plan: Callable[[bytes], PlanPicture | None]
    goal: Callable[[bytes], Array]
    status: Callable[[bytes], tuple[str, Status]]
    numbers: Callable[[bytes], Mapping[str, float]]


class Event(NamedTuple):
    """Something worth jumping to: time, s, what kind ('goal', 'contact', 'stop', 'released'), and more in words."""

    time: float
    kind: str
    text: str


class _Messages(NamedTuple):
    """Where the messages of a topic are: times of reception (n,) ns, and the `Place` of each (n, 3)."""

    times: Times
    places: Times

    def before(self, time_ns: int) -> int:
        """Row of the last message received until then; -1 if there is none."""
        return int(np.searchsorted(self.times, time_ns, side="right")) - 1


class Recording:
    """A bag, opened for looking at any of its moments.

    Parameters
    ----------
    path
        The bag.
    decoders
        For messages that are not only numbers.

    Attributes
    ----------
    duration
        From the first to the last joint state, s.
    ticks
        (n,) times of the joint states since the first, s, increasing.
    events
        By time.

    Raises
    ------
    BagError
        If the bag cannot be read or holds no joint states.
    """

    def __init__(self, path: Path, decoders: Decoders) -> None:
        self.path = path
        self._decode = decoders
        reader = BagReader(path)
        files = reader.indexed_files()
        self._source: BagIndex | UnindexedBag = BagIndex(files) if files else UnindexedBag(reader)
        self._read()
        self._goals = self._read_goals()
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
            obstacles=self._newest(_OBSTACLES, until_ns, self._decode.obstacles),
            plan=self._newest(_PICTURES, until_ns, self._decode.plan),
            forces=dict(zip(_LINKS, self._forces[contact].tolist(), strict=True)) if contact >= 0 else {},
            goal=self._goals[1][goal] if goal >= 0 else None,
            safety=self._safety_at(until_ns),
        )

    def tick(self, time: float) -> int:
        """Number of the last joint state at or before a time, s."""
        return max(self._row(self.ticks, time), 0)

    def table(self, time: float) -> Array:
        """Time and `QUANTITIES` over the last `SPAN` seconds up to a time, as `History.table`."""
        first, last = np.searchsorted(self._table[:, 0], [time - SPAN, time + 1e-9])
        return thinned(self._table[first:last])

    def next_contact(self, time: float) -> float | None:
        """Start of the first contact after a time, s; None if there is no more."""
        return next((event.time for event in self.events if event.kind == "contact" and event.time > time + 1e-6), None)

    def _read(self) -> None:
        columns = {
            _STATES: JointStates(["position"], iiwa14.JOINT_NAMES),
            _TORQUES: JointStates(["effort"], iiwa14.JOINT_NAMES),
            _CONTACTS: JointStates(["effort"], (*_LINKS, "max")),
            _PLANS: Stamps(),
        }
        said: list[_Said] = []
        places: dict[str, list[Times]] = {topic: [] for topic in _ASKED_FOR}
        for chunk, blocks in self._source.scan({*columns, *_ASKED_FOR}):
            for topic, block in blocks.items():
                if topic in columns:
                    columns[topic].add_block(block)
                    continue
                place = [block.log_ns, np.full(len(block.starts), chunk), block.starts, block.sizes]
                places[topic].append(np.stack(place, axis=1))
                if topic == _SAFETY:
                    said += _statuses(block)
        states, torques, contacts = (columns[topic].column() for topic in (_STATES, _TORQUES, _CONTACTS))
        # What the arm's joints are not known of, or what came twice, is no moment to look at.
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
        self._messages: dict[str, _Messages] = {}
        for topic, tables in places.items():
            table = np.concatenate(tables) if tables else np.zeros((0, 4), np.int64)
            order = np.argsort(table[:, 0], kind="stable")
            table = table[order]
            self._messages[topic] = _Messages(table[:, 0], table[:, 1:])
            if topic == _SAFETY:
                self._said = [said[row] for row in order]
        self._speakers = {
            name: np.array([row for row, entry in enumerate(self._said) if entry.name == name], np.int64)
            for name in {entry.name for entry in self._said}
        }
        self._kept: dict[str, tuple[int, Any]] = {}

    def _time_of(self, received_ns: int | Times) -> Array:
        """Robot's time, s, at times of reception."""
        return np.asarray(np.interp(received_ns, self._received, self.ticks))

    def _row(self, times: Array, time: float) -> int:
        return int(np.searchsorted(times, time + 1e-9, side="right")) - 1

    def _raw(self, topic: str, row: int) -> bytes:
        return self._source.message(Place(*self._messages[topic].places[row].tolist()))

    def _newest(self, topic: str, until_ns: int, decode: Callable[[bytes], T]) -> T | None:
        row = self._messages[topic].before(until_ns)
        return self._decoded(topic, topic, row, decode) if row >= 0 else None

    def _decoded(self, key: str, topic: str, row: int, decode: Callable[[bytes], T]) -> T | None:
        """A message; the last one of each key is kept. None for one that says nothing."""
        kept = self._kept.get(key)
        if kept is None or kept[0] != row:
            try:
                kept = row, decode(self._raw(topic, row))
            except InputError:
                kept = row, None
            self._kept[key] = kept
        value: T | None = kept[1]
        return value

    def _safety_at(self, until_ns: int) -> dict[str, Status]:
        last = self._messages[_SAFETY].before(until_ns)
        found = {}
        for name, rows in sorted(self._speakers.items()):
            place = int(np.searchsorted(rows, last, side="right")) - 1
            if place >= 0:
                status = self._decoded(f"{_SAFETY} {name}", _SAFETY, int(rows[place]), self._decode.status)
                if status is not None:
                    found[name] = status[1]
        return found

    def _read_goals(self) -> tuple[Array, Array]:
        """When goals were sent, (n,), s, and where they are, (n, 3), m."""
        times, positions = [], []
        for row, received in enumerate(self._messages[_GOALS].times):
            try:
                positions.append(self._decode.goal(self._raw(_GOALS, row)))
            except InputError:
                continue
            times.append(float(self._time_of(received)))
        return np.array(times), np.array(positions).reshape(-1, 3)

    def _find_events(self) -> tuple[Event, ...]:
        events = [
            Event(time, "goal", f"goal {np.round(position, 3).tolist()} m")
            for time, position in zip(self._goals[0].tolist(), self._goals[1], strict=True)
        ]
        stopped: dict[str, bool] = {}
        in_contact = []
        received_at = self._time_of(self._messages[_SAFETY].times).tolist()
        for time, entry in zip(received_at, self._said, strict=True):
            is_stop = entry.level is Level.STOP
            if is_stop != stopped.get(entry.name, False):
                stopped[entry.name] = is_stop
                text = f"{entry.name}: {entry.message}"
                events.append(Event(time, "stop" if is_stop else "released", text))
            if entry.level is Level.CONTACT:
                in_contact.append(time)
        if len(self._contact_times):
            touched = self._contact_times[self._largest >= _CONTACT_FORCE]
        else:
            touched = np.array(in_contact)
        starts = touched[np.append(True, np.diff(touched) > _CONTACT_PAUSE)[: len(touched)]]
        events += [Event(float(time), "contact", "contact begins") for time in starts]
        return tuple(sorted(events))

    def _make_table(self) -> Array:
        """All plotted quantities at equal times."""
        times = np.arange(0.0, self.duration + 0.5 * _SAMPLES, _SAMPLES)
        table = np.full((len(times), 1 + len(QUANTITIES)), np.nan)
        columns = dict(zip(("time", *QUANTITIES), table.T, strict=True))
        columns["time"][:] = times
        goal = np.searchsorted(self._goals[0], times, side="right") - 1
        known = np.flatnonzero(goal >= 0)
        if len(known):
            ticks = np.searchsorted(self.ticks, times[known] + 1e-9, side="right") - 1
            flange = flange_positions(self._q[ticks])
            columns["distance"][known] = 1000.0 * np.linalg.norm(flange - self._goals[1][goal[known]], axis=1)
        place = np.searchsorted(times, self._contact_times)
        inside = place < len(times)
        np.fmax.at(columns["force"], place[inside], self._largest[inside])
        _hold(columns["force"])
        if len(self._torque_times):
            rows = np.searchsorted(self._torque_times, times + 1e-9, side="right") - 1
            for joint, name in enumerate(JOINTS):
                columns[name][:] = np.where(rows >= 0, self._torques[rows, joint], np.nan)
        if len(self._plan_times):
            rows = np.searchsorted(self._plan_times, times + 1e-9, side="right") - 1
            columns["plan age"][:] = np.where(rows >= 0, 1000.0 * (times - self._plan_times[rows]), np.nan)
        places = np.searchsorted(times, self._time_of(self._messages[_NUMBERS].times)).tolist()
        for row, at in enumerate(places):
            raw = self._raw(_NUMBERS, row)
            # There are thousands, and only the driver's tell it.
            if _ROUND_TRIP not in raw:
                continue
            try:
                numbers = self._decode.numbers(raw)
            except InputError:
                continue
            for name in ("p50", "p99"):
                if at < len(times) and f"driver/round trip {name} us" in numbers:
                    columns[f"round trip {name}"][at] = numbers[f"driver/round trip {name} us"]
        for name in ("p50", "p99"):
            _hold(columns[f"round trip {name}"])
        return table


class _Said(NamedTuple):
    """A safety state, without what belongs to it."""

    name: str
    level: Level
    message: str


def _statuses(block: Block) -> list[_Said]:
    """What serialised DiagnosticStatus messages say; there may be tens of thousands, most of them alike."""
    found = []
    for row in range(len(block.starts)):
        data = block.data(row)
        try:
            name, message = text_at(data, 8), text_at(data, after_string(data, 8))
        except (struct.error, UnicodeDecodeError):
            name = message = ""
        level = Level(min(data[4], Level.STOP.value)) if len(data) > 4 else Level.OK
        found.append(_Said(name, level, message))
    return found


def _hold(values: Array) -> None:
    """Fill gaps with what was known last."""
    known = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    values[:] = np.where(known >= 0, values[known], np.nan)
