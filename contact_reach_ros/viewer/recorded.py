"""A bag as the page shows it: any moment of it, and what happened when."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.errors import BagError, InputError
from contact_reach_ros.planning.problem import Spheres
from contact_reach_ros.recording.bag_reader import BagReader
from contact_reach_ros.recording.index import BagIndex, JointColumns, Rows
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.robot.kinematics import link_frames_of_many
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.viewer.frame import Frame, Level, PlanPicture, Status
from contact_reach_ros.viewer.history import JOINTS, QUANTITIES, SPAN, thinned

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_STATES, _TORQUES, _CONTACTS = "/joint_states", "/external_torque", "/sim/contacts"
_PLANS, _PICTURES, _OBSTACLES = "/reference/pose", "/plan/markers", "/obstacles"
_GOALS, _SAFETY, _NUMBERS = "/goal_pose", "/safety_state", "/diagnostics"
_WHOLE = (_STATES, _TORQUES, _CONTACTS, _PLANS, _SAFETY)
_PLACED = (_PICTURES, _OBSTACLES, _GOALS, _SAFETY, _NUMBERS)

_SAMPLES = 0.02
"""Time between the points of a curve, s: the rate of the fastest plotted quantities is thinned to that anyway."""
_CONTACT_FORCE = 0.5
"""True force that counts as a contact, N."""
_CONTACT_PAUSE = 0.3
"""Time without a contact after which the next is another one, s."""
_ROUND_TRIP = b"round trip"
_NUMBER = struct.Struct("<I")

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
    """Where the messages of a topic are: times of reception (n,) ns, and chunk and offset of each (n, 2)."""

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
        self._source: BagIndex | _Unindexed = BagIndex(files) if files else _Unindexed(reader)
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
            _STATES: JointColumns(iiwa14.JOINT_NAMES, ["position"]),
            _TORQUES: JointColumns(iiwa14.JOINT_NAMES, ["effort"]),
            _CONTACTS: JointColumns((*_LINKS, "max"), ["effort"]),
        }
        plans: list[Times] = []
        said: list[_Said] = []
        places: dict[str, list[NDArray[np.int64]]] = {topic: [] for topic in _PLACED}
        for chunk, rows, pairs in self._source.scan(_WHOLE, _PLACED):
            for topic, found in rows.items():
                if topic in columns:
                    columns[topic].add(found)
                elif topic == _PLANS:
                    plans.append(_stamps(found))
                else:
                    said += _statuses(found)
            for topic, pair in pairs.items():
                parts = [pair["time"], np.full(len(pair), chunk), pair["offset"]]
                places[topic].append(np.stack([part.astype(np.int64) for part in parts], axis=1))
        received, stamps, positions = columns[_STATES].result()
        # What the arm's joints are not known of, or what came twice, is no moment to look at.
        good = np.asarray(np.isfinite(positions).all(axis=(1, 2)))
        good[1:] &= stamps[1:] > np.maximum.accumulate(stamps)[:-1]
        if not good.any():
            raise BagError(f"{self.path}: holds no joint states of the arm; record joint_states")
        self._received, stamps, self._q = received[good], stamps[good], positions[good, 0]
        self._start_ns = int(stamps[0])
        self.ticks = (stamps - self._start_ns) / NANOSECONDS
        self.duration = float(self.ticks[-1])
        _, torque_stamps, torques = columns[_TORQUES].result()
        self._torque_times, self._torques = (torque_stamps - self._start_ns) / NANOSECONDS, torques[:, 0]
        _, contact_stamps, contacts = columns[_CONTACTS].result()
        self._contact_times = (contact_stamps - self._start_ns) / NANOSECONDS
        self._forces, self._largest = contacts[:, 0, :-1], contacts[:, 0, -1]
        effects = np.sort(np.concatenate(plans)) if plans else np.zeros(0, np.int64)
        self._plan_times = (effects - self._start_ns) / NANOSECONDS
        self._messages: dict[str, _Messages] = {}
        for topic, tables in places.items():
            table = np.concatenate(tables) if tables else np.zeros((0, 3), np.int64)
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
        chunk, offset = self._messages[topic].places[row].tolist()
        return self._source.message(chunk, offset)

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
            flange = link_frames_of_many(self._q[ticks])[1][-1].T
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


class _Unindexed:
    """A bag whose recording was not closed: read message by message, and kept."""

    def __init__(self, reader: BagReader) -> None:
        self._reader = reader
        self._kept: list[bytes] = []

    def scan(
        self, whole: tuple[str, ...], placed: tuple[str, ...]
    ) -> Iterator[tuple[int, Mapping[str, Rows], Mapping[str, NDArray[np.void]]]]:
        """As `BagIndex.scan`, in one piece."""
        wanted = [topic for topic in self._reader.topics() if topic in whole or topic in placed]
        found: dict[str, list[tuple[int, bytes]]] = {}
        pairs: dict[str, list[tuple[int, int]]] = {}
        for raw in self._reader.raw_messages(wanted):
            if raw.topic in whole:
                found.setdefault(raw.topic, []).append((raw.log_time_ns, raw.data))
            if raw.topic in placed:
                pairs.setdefault(raw.topic, []).append((raw.log_time_ns, len(self._kept)))
                self._kept.append(raw.data)
        kind = np.dtype([("time", "<i8"), ("offset", "<i8")])
        rows = {topic: _as_rows(messages) for topic, messages in found.items()}
        yield 0, rows, {topic: np.array(entries, kind) for topic, entries in pairs.items()}

    def message(self, chunk: int, offset: int) -> bytes:
        """As `BagIndex.message`."""
        return self._kept[offset]


def _as_rows(messages: list[tuple[int, bytes]]) -> Rows:
    sizes = np.array([len(data) for _, data in messages], np.int64)
    joined = b"".join(data.ljust(sizes.max(), b"\0") for _, data in messages)
    times = np.array([time for time, _ in messages], np.int64)
    return Rows(times, np.frombuffer(joined, np.uint8).reshape(len(messages), -1), sizes)


def _stamps(rows: Rows) -> Times:
    """Of the headers that messages begin with, ns."""
    stamps = np.ascontiguousarray(rows.data[rows.sizes >= 12][:, 4:12])
    return stamps.view("<i4")[:, 0].astype(np.int64) * NANOSECONDS + stamps.view("<u4")[:, 1]


def _statuses(rows: Rows) -> list[_Said]:
    """What serialised DiagnosticStatus messages say; there may be tens of thousands, most of them alike."""
    found = []
    for row, size in zip(rows.data, rows.sizes.tolist(), strict=True):
        data = row[:size].tobytes()
        try:
            name, at = _text(data, 8)
            message, _ = _text(data, at)
        except (struct.error, UnicodeDecodeError):
            name = message = ""
        level = Level(min(data[4], Level.STOP.value)) if len(data) > 4 else Level.OK
        found.append(_Said(name, level, message))
    return found


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A string of a serialised message, and where the next field begins that is aligned to four bytes."""
    (length,) = _NUMBER.unpack_from(data, at)
    end = at + 4 + length
    return data[at + 4 : end - 1].decode(), end + -(end - 4) % 4


def _hold(values: Array) -> None:
    """Fill gaps with what was known last."""
    known = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    values[:] = np.where(known >= 0, values[known], np.nan)
