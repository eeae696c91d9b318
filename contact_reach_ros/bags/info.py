"""Overview of a bag from its index: topics, rates, gaps and lost messages.

In lockstep messages come as fast as the machine computes them, which is no property of the robot: rates and gaps are
then on the robot's clock, to which the stamps of the joint states translate the times of reception.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from contact_reach_ros.bags.columns import Stamps, read_raw
from contact_reach_ros.bags.loss import LOST
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.units import NANOSECONDS

GAP_RATIO = 5.0
"""A gap is this many times longer than the median time between two messages of its topic..."""
GAP_LEAST_S = 0.01
"""... and not shorter than this, s."""
_FEW = 100
"""With fewer messages the median time between them means little, and gaps are not counted."""
_MEGA = 1e6
_STATES, _LOCKSTEP = "/joint_states", "/clock"
"""The robot's clock, and a topic of which there are messages in lockstep only."""
_Clock = Callable[[np.ndarray], np.ndarray]
_WIDE = 150
"""Width of a table that includes the types, characters."""


@dataclasses.dataclass(frozen=True)
class TopicInfo:
    """One topic.

    Attributes
    ----------
    name, type, message_count :
        As in the bag.
    qos :
        Offered quality of service in words, such as "reliable, latched".
    rate_hz :
        Mean rate from the first to the last message, Hz; NaN for fewer than two.
    gaps :
        Number of gaps, see `GAP_RATIO`; None for fewer than 100 messages.
    longest_gap_s :
        Longest time between two messages, s; NaN for fewer than two.
    out_of_order :
        Number of messages received before their predecessor in the file.
    lost :
        Number of messages that did not reach the recorder, None if unknown.
    """

    name: str
    type: str
    message_count: int
    qos: str
    rate_hz: float
    gaps: int | None
    longest_gap_s: float
    out_of_order: int
    lost: int | None


@dataclasses.dataclass(frozen=True)
class BagInfo:
    """A bag: size in bytes, start in ns since the epoch, durations in s, topics, custom data and notes.

    `robot_duration_s` is that of a run in lockstep on the robot's clock, on which the rates and gaps of the topics are
    then; None in real time.
    """

    path: Path
    size: int
    start_ns: int
    duration_s: float
    robot_duration_s: float | None
    message_count: int
    topics: tuple[TopicInfo, ...]
    custom_data: dict[str, str]
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON; NaN becomes None."""
        content = dataclasses.asdict(self) | {"path": str(self.path), "notes": list(self.notes)}
        for topic in content["topics"]:
            topic |= {key: None for key, value in topic.items() if isinstance(value, float) and np.isnan(value)}
        return content


def read_info(path: Path) -> BagInfo:
    """Summarise a bag; raises `BagError` if nothing of it can be read."""
    reader = BagReader(path)
    summary = reader.summary
    on_clock = _robot_clock(reader)
    topics = tuple(
        _topic_info(topic, reader.reception_times(name), summary.custom_data, on_clock)
        for name, topic in sorted(summary.topics.items())
    )
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    return BagInfo(
        path,
        sum(file.stat().st_size for file in files),
        summary.start_ns,
        summary.duration,
        None if on_clock is None else float(np.ptp(on_clock(reader.reception_times(_STATES)))) / NANOSECONDS,
        summary.message_count,
        topics,
        dict(summary.custom_data),
        reader.notes,
    )


def _robot_clock(reader: BagReader) -> _Clock | None:
    """Translates times of reception, ns, to the robot's clock; None in real time, or without joint states."""
    if _LOCKSTEP not in reader.topics() or _STATES not in reader.topics():
        return None
    stamps = Stamps()
    read_raw(reader, {_STATES: stamps})
    states = stamps.column()
    received_ns, first = np.unique(states.log_ns, return_index=True)
    if not len(received_ns):
        return None
    begin_ns = states.stamp_ns[0]
    since = (states.stamp_ns[first] - begin_ns).astype(float)
    return lambda times_ns: np.interp(times_ns, received_ns, since)


def _topic_info(
    topic: RecordedTopic, times_ns: np.ndarray, custom_data: Mapping[str, str], on_clock: _Clock | None
) -> TopicInfo:
    steps = np.diff(times_ns)
    if on_clock is not None:
        times_ns = np.sort(on_clock(times_ns))
        # Before time begins, everything is repeated until everybody has received it.
        times_ns = times_ns[max(np.count_nonzero(times_ns == 0.0) - 1, 0) :]
    rate = gap = float("nan")
    gaps = None
    if len(times_ns) > 1:
        span = float(times_ns.max() - times_ns.min()) / NANOSECONDS
        rate = (len(times_ns) - 1) / span if span > 0.0 else float("nan")
        forward = np.diff(np.sort(times_ns)) / NANOSECONDS
        gap = float(forward.max())
        if len(times_ns) >= _FEW:
            gaps = int(np.count_nonzero(forward > max(GAP_RATIO * float(np.median(forward)), GAP_LEAST_S)))
    return TopicInfo(
        topic.name,
        topic.type,
        topic.message_count,
        _qos(topic),
        rate,
        gaps,
        gap,
        int(np.count_nonzero(steps < 0)),
        _lost(topic.name, custom_data),
    )


def _lost(topic: str, custom_data: Mapping[str, str]) -> int | None:
    if not custom_data.get(LOST, "").isdigit():
        return None
    of_topic = custom_data.get(f"{LOST}{topic}", "0")
    return int(of_topic) if of_topic.isdigit() else None


def _qos(topic: RecordedTopic) -> str:
    if not topic.offered_qos:
        return "not known"
    words = sorted({profile.reliability.replace("_", " ") for profile in topic.offered_qos}, reverse=True)
    latched = any(profile.durability == "transient_local" for profile in topic.offered_qos)
    return ", ".join([*words, *(["latched"] if latched else [])])


def bag_info(path: Path, file: Path | None, console: Console | None = None) -> None:
    """Print an overview of a bag, and write it as JSON if a file is given.

    Raises `BagError` if nothing of it can be read.
    """
    info = read_info(path)
    if file is not None:
        file.write_text(json.dumps(info.as_json(), indent=2) + "\n")
    console = console or _console()
    began = datetime.fromtimestamp(info.start_ns / NANOSECONDS).isoformat(" ", "milliseconds") if info.start_ns else "-"
    console.print(
        f"[bold]{info.path}[/]: {info.message_count} messages in {info.duration_s:.3f} s from {began},"
        f" {info.size / _MEGA:.1f} MB",
        highlight=False,
    )
    if info.robot_duration_s is not None:
        console.print(
            f"lockstep: {info.robot_duration_s:.3f} s on the robot's clock; rates and gaps are on it, too",
            highlight=False,
        )
    console.print(_table(info.topics, with_type=console.width >= _WIDE))
    for key, value in sorted(info.custom_data.items()):
        if not key.startswith(f"{LOST}/"):
            lines = value.splitlines()
            shown = value if len(lines) <= 1 else f"({len(lines)} lines)"
            console.print(f"  {key}: {shown}", highlight=False, markup=False)
    for note in info.notes:
        console.print(f"note: {note}", style="yellow", highlight=False, markup=False)


def _console() -> Console:
    """Return a console as wide as the terminal, or wide enough for every column if the output is a file or pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=_WIDE)


def _table(topics: Sequence[TopicInfo], with_type: bool) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("topic", overflow="fold")
    if with_type:
        table.add_column("type", no_wrap=True)
    for name in ("messages", "Hz", "gaps", "longest ms", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("QoS", no_wrap=True)
    for topic in topics:
        lost = "?" if topic.lost is None else str(topic.lost)
        late = f" ({topic.out_of_order} out of order)" if topic.out_of_order else ""
        table.add_row(
            topic.name,
            *([topic.type] if with_type else []),
            f"{topic.message_count}{late}",
            _number(topic.rate_hz),
            "-" if topic.gaps is None else str(topic.gaps),
            _number(1e3 * topic.longest_gap_s),
            f"[red]{lost}[/]" if topic.lost else lost,
            topic.qos,
        )
    return table


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.1f}"
