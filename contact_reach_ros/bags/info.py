"""Overview of a bag: topics, rates, longest gaps and lost messages."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from contact_reach_ros.bags.loss import LOST
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

_LOCKSTEP = "/clock"
"""A topic of which there are messages in lockstep only."""
_WIDE = 150
"""Width of the table where the output is no terminal, characters."""


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
        Mean rate from the first to the last message, Hz; None for fewer than two.
    longest_gap_s :
        Longest time between two messages, s; None for fewer than two.
    lost :
        Number of messages that did not reach the recorder, None if unknown.
    """

    name: str
    type: str
    message_count: int
    qos: str
    rate_hz: float | None
    longest_gap_s: float | None
    lost: int | None


@dataclasses.dataclass(frozen=True)
class BagInfo:
    """A bag: size in bytes, start in ns since the epoch, duration in s, topics, custom data and notes.

    In lockstep, rates and gaps show the pace of the machine that computed, not that of the robot.
    """

    path: str
    size: int
    start_ns: int
    duration_s: float
    message_count: int
    in_lockstep: bool
    topics: tuple[TopicInfo, ...]
    custom_data: dict[str, str]
    notes: tuple[str, ...]


def read_info(path: Path) -> BagInfo:
    """Summarise a bag; raises `BagError` if nothing of it can be read."""
    reader = BagReader(path)
    summary = reader.summary
    data = dict(summary.custom_data)
    topics = tuple(_topic_info(summary.topics[name], reader, data) for name in sorted(summary.topics))
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    return BagInfo(
        str(path),
        sum(file.stat().st_size for file in files),
        summary.start_ns,
        summary.duration,
        summary.message_count,
        _LOCKSTEP in summary.topics,
        topics,
        data,
        reader.notes,
    )


def _topic_info(topic: RecordedTopic, reader: BagReader, custom_data: Mapping[str, str]) -> TopicInfo:
    times_ns = reader.reception_times(topic.name)
    steps = np.diff(np.sort(times_ns)) / NANOSECONDS
    rate = gap = None
    if len(steps):
        gap = float(steps.max())
        rate = len(steps) / float(steps.sum()) if gap > 0.0 else None
    lost = custom_data.get(f"{LOST}{topic.name}", "0") if custom_data.get(LOST, "").isdigit() else ""
    known_lost = int(lost) if lost.isdigit() else None
    return TopicInfo(topic.name, topic.type, topic.message_count, _qos(topic), rate, gap, known_lost)


def _qos(topic: RecordedTopic) -> str:
    if not topic.offered_qos:
        return "not known"
    words = sorted({profile.reliability.replace("_", " ") for profile in topic.offered_qos}, reverse=True)
    latched = any(profile.durability == "transient_local" for profile in topic.offered_qos)
    return ", ".join([*words, *(["latched"] if latched else [])])


def bag_info(path: Path, file: Path | None, console: Console | None = None) -> None:
    """Print an overview of a bag, and write it as JSON if a file is given.

    Raises `BagError` if nothing of it can be read, or the file cannot be written.
    """
    info = read_info(path)
    if file is not None:
        try:
            file.write_text(json.dumps(dataclasses.asdict(info), indent=2) + "\n")
        except OSError as error:
            raise BagError(f"--json {file}: cannot be written ({error.strerror}); name a file that can be") from error
    console = console or Console()
    if not console.is_terminal:
        console.width = _WIDE
    began = datetime.fromtimestamp(info.start_ns / NANOSECONDS).isoformat(" ", "milliseconds") if info.start_ns else "-"
    console.print(
        f"[bold]{info.path}[/]: {info.message_count} messages in {info.duration_s:.3f} s from {began},"
        f" {info.size / 1e6:.1f} MB",
        highlight=False,
    )
    if info.in_lockstep:
        console.print("lockstep: rates and gaps show the pace of the machine that computed, not that of the robot")
    console.print(_table(info.topics))
    for key, value in sorted(info.custom_data.items()):
        if not key.startswith(f"{LOST}/"):
            lines = len(value.splitlines())
            shown = value if lines <= 1 else f"({lines} lines)"
            console.print(f"  {key}: {shown}", highlight=False, markup=False)
    for note in info.notes:
        console.print(f"note: {note}", style="yellow", highlight=False, markup=False)


def _table(topics: Sequence[TopicInfo]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("messages", "Hz", "longest gap ms", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("QoS", no_wrap=True)
    for topic in topics:
        lost = "?" if topic.lost is None else str(topic.lost)
        table.add_row(
            topic.name,
            topic.type,
            str(topic.message_count),
            "-" if topic.rate_hz is None else f"{topic.rate_hz:.1f}",
            "-" if topic.longest_gap_s is None else f"{1e3 * topic.longest_gap_s:.1f}",
            f"[red]{lost}[/]" if topic.lost else lost,
            topic.qos,
        )
    return table
