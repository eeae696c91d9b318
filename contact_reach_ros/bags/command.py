"""`contact-reach bag info` and `contact-reach bag repair`."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import LOST, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

REPAIRED_FROM = "repaired_from"
"""Key of the custom data that names the bag which was repaired."""

_WIDE = 150
"""Width of the table where the output is no terminal, characters."""


def read_info(path: Path) -> dict[str, Any]:
    """Summarise a bag: size in bytes, start in ns since the epoch, duration in s, topics, custom data and notes.

    Of a topic, rate_hz is the mean from the first to the last message, longest_gap_s the longest time between two; both
    are None for fewer than two messages, lost is None if unknown. Raises `BagError` if nothing of the bag can be read.
    """
    reader = BagReader(path)
    summary = reader.summary
    times_ns: defaultdict[str, list[int]] = defaultdict(list)
    for raw in reader.raw_messages():
        times_ns[raw.topic].append(raw.log_time_ns)
    topics = [
        _topic_info(topic, np.array(times_ns[name], np.int64), summary.custom_data)
        for name, topic in sorted(summary.topics.items())
    ]
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    return {
        "path": str(path),
        "size": sum(file.stat().st_size for file in files),
        "start_ns": summary.start_ns,
        "duration_s": summary.duration,
        "message_count": summary.message_count,
        "topics": topics,
        "custom_data": dict(summary.custom_data),
        "notes": reader.notes,
    }


def _topic_info(topic: RecordedTopic, times_ns: NDArray[np.int64], custom_data: Mapping[str, str]) -> dict[str, Any]:
    steps = np.diff(np.sort(times_ns)) / NANOSECONDS
    rate = gap = None
    if len(steps):
        gap = float(steps.max())
        rate = len(steps) / float(steps.sum()) if gap > 0.0 else None
    lost = custom_data.get(f"{LOST}{topic.name}", "0") if custom_data.get(LOST, "").isdigit() else ""
    return {
        "name": topic.name,
        "type": topic.type,
        "message_count": topic.message_count,
        "qos": _qos(topic),
        "rate_hz": rate,
        "longest_gap_s": gap,
        "lost": int(lost) if lost.isdigit() else None,
    }


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
            file.write_text(json.dumps(info, indent=2) + "\n")
        except OSError as error:
            raise BagError(f"--json {file}: cannot be written ({error.strerror}); name a file that can be") from error
    console = console or Console()
    if not console.is_terminal:
        console.width = _WIDE
    start_ns = info["start_ns"]
    began = datetime.fromtimestamp(start_ns / NANOSECONDS).isoformat(" ", "milliseconds") if start_ns else "-"
    console.print(
        f"[bold]{info['path']}[/]: {info['message_count']} messages in {info['duration_s']:.3f} s from {began},"
        f" {info['size'] / 1e6:.1f} MB",
        highlight=False,
    )
    console.print(_table(info["topics"]))
    for key, value in sorted(info["custom_data"].items()):
        if not key.startswith(f"{LOST}/"):
            lines = len(value.splitlines())
            shown = value if lines <= 1 else f"({lines} lines)"
            console.print(f"  {key}: {shown}", highlight=False, markup=False)
    for note in info["notes"]:
        console.print(f"note: {note}", style="yellow", highlight=False, markup=False)


def repair_bag(bag: Path, output: Path | None = None) -> None:
    """Write all messages that can be read into a new bag, and print what it lacks; the old one stays unchanged.

    Raises `BagError` if nothing can be read, or the new bag exists or cannot be written.

    Parameters
    ----------
    bag :
        A bag, or one of its files.
    output :
        Directory to create; when None, the old bag's name with "_repaired" appended.
    """
    reader = BagReader(bag)
    whole = bag.resolve()
    output = output or whole.with_name(f"{whole.name if bag.is_dir() else whole.stem}_repaired")
    left_out = []
    with BagWriter(output, custom_data={**reader.summary.custom_data, REPAIRED_FROM: whole.name}) as writer:
        kept = []
        for topic in reader.topics().values():
            try:
                writer.add_topic(topic, reader.definition(topic.type))
                kept.append(topic.name)
            except BagError as error:
                left_out.append(f"topic '{topic.name}' is left out: {error}")
        for raw in reader.raw_messages(kept):
            writer.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    for note in (*reader.notes, *left_out):
        print(f"note: {note}")
    print(f"{writer.message_count} messages of {len(kept)} topics are in {writer.directory}")


def _table(topics: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("messages", "Hz", "longest gap ms", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("QoS", no_wrap=True)
    for topic in topics:
        rate, gap = topic["rate_hz"], topic["longest_gap_s"]
        lost = "?" if topic["lost"] is None else str(topic["lost"])
        table.add_row(
            topic["name"],
            topic["type"],
            str(topic["message_count"]),
            "-" if rate is None else f"{rate:.1f}",
            "-" if gap is None else f"{1e3 * gap:.1f}",
            f"[red]{lost}[/]" if topic["lost"] else lost,
            topic["qos"],
        )
    return table
