"""Repairs damaged and unfinished bags: writes what can be read into a complete bag."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError

ENDING = "_repaired"
REPAIRED_FROM = "repaired_from"
"""Key of the custom data that names the bag which was repaired."""


@dataclasses.dataclass(frozen=True)
class Repair:
    """The new bag, its messages and topics, and notes: defects of the old bag, and what the new one leaves out."""

    bag: Path
    message_count: int
    topic_count: int
    notes: tuple[str, ...]


def repair_bag(path: Path, output: Path | None = None) -> Repair:
    """Write all messages that can be read into a new bag; the old one stays unchanged.

    Raises `BagError` if nothing can be read, or the new bag exists or cannot be written.

    Parameters
    ----------
    path :
        A bag, or one of its files.
    output :
        Directory to create; when None, the old bag's name with "_repaired" appended.
    """
    reader = BagReader(path)
    whole = path.resolve()
    output = output or whole.with_name(f"{whole.name if path.is_dir() else whole.stem}{ENDING}")
    left_out = []
    data = {**reader.summary.custom_data, REPAIRED_FROM: whole.name}
    with BagWriter(output, custom_data=data) as writer:
        kept = []
        for topic in reader.topics().values():
            try:
                writer.add_topic(topic, reader.definition(topic.type))
                kept.append(topic.name)
            except BagError as error:
                left_out.append(f"topic '{topic.name}' is left out: {error}")
        for raw in reader.raw_messages(kept):
            writer.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    return Repair(writer.directory, writer.message_count, len(kept), (*reader.notes, *left_out))
