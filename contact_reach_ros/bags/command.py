"""`contact-reach bag info`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import LOST, RecordedTopic
from contact_reach_ros.resources import write_json
from contact_reach_ros.timing import NANOSECONDS

_WIDE = 150
"""Width of the table where the output is no terminal, characters."""


def read_info(path: Path) -> dict[str, Any]:
    """Summarise a bag: size in bytes, start in ns since the epoch, duration in s, topics, custom data and notes.

    Of a topic, rate_hz is the mean from the first to the last message, longest_gap_s the longest time between two; both
    are None for fewer than two messages, lost is None if unknown. Raises `BagError` if nothing of the bag can be read.
    """
    reader = BagReader(path)
    times_ns: defaultdict[str, list[NDArray[np.int64]]] = defaultdict(list)

    def keep(name: str, messages: Messages) -> None:
        # A copy, since the view would keep the messages.
        times_ns[name].append(messages["log_ns"].copy())

    reader.pass_on({name: partial(keep, name) for name in reader.topics})
    files = [file for file in path.iterdir() if file.is_file()] if path.is_dir() else [path]
    return {
        "path": str(path),
        "size": sum(file.stat().st_size for file in files),
        "start_ns": reader.start_ns,
        "duration_s": reader.duration,
        "message_count": reader.message_count,
        "topics": [
            _topic_info(topic, np.concatenate([np.zeros(0, np.int64), *times_ns[name]]), reader.custom_data)
            for name, topic in sorted(reader.topics.items())
        ],
        "custom_data": reader.custom_data,
        "notes": reader.notes,
    }


def _topic_info(topic: RecordedTopic, times_ns: NDArray[np.int64], custom_data: Mapping[str, str]) -> dict[str, Any]:
    steps = np.diff(times_ns) / NANOSECONDS
    gap = float(steps.max()) if len(steps) else None
    lost = custom_data.get(f"{LOST}{topic.name}", "0") if custom_data.get(LOST, "").isdigit() else ""
    return {
        "name": topic.name,
        "type": topic.type,
        "message_count": topic.message_count,
        "latched": topic.latched,
        "rate_hz": len(steps) / float(steps.sum()) if gap else None,
        "longest_gap_s": gap,
        "lost": int(lost) if lost.isdigit() else None,
    }


def bag_info(path: Path, file: Path | None) -> None:
    """Print an overview of a bag, and write it as JSON if a file is given.

    Raises `ContactReachError` if nothing of it can be read, or the file cannot be written.
    """
    info = read_info(path)
    if file is not None:
        write_json(file, info)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDE
    start_ns = info["start_ns"]
    began = datetime.fromtimestamp(start_ns / NANOSECONDS).isoformat(" ", "milliseconds") if start_ns else "-"
    console.print(
        f"[bold]{escape(info['path'])}[/]: {info['message_count']} messages in {info['duration_s']:.3f} s from {began},"
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


def _table(topics: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("messages", "Hz", "longest gap ms", "lost"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("latched", no_wrap=True)
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
            "yes" if topic["latched"] else "",
        )
    return table
