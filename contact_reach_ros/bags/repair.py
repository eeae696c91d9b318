"""Repairs damaged and unfinished bags: writes what can be read into a complete bag."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError

ENDING = "_repaired"
REPAIRED_FROM = "repaired_from"
"""Key of the custom data that names the bag which was repaired."""


@dataclasses.dataclass(frozen=True)
class Repair:
    """Result of a repair.

    Attributes
    ----------
    bag :
        The new bag.
    message_count, topic_count :
        Number of its messages and topics.
    notes :
        Defects of the old bag, and what is left out of the new one.
    """

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
    if output is None:
        whole = path.resolve()
        name = whole.name if path.is_dir() else whole.stem
        output = _free(whole.parent / f"{name}{ENDING}")
    notes = []
    data = {**reader.summary.custom_data, REPAIRED_FROM: path.resolve().name}
    with BagWriter(output, custom_data=data) as writer:
        kept = []
        for topic in reader.topics().values():
            try:
                definition = reader.definition(topic.type)
            except BagError as error:
                notes.append(f"topic '{topic.name}' is left out: {error}")
                continue
            writer.add_topic(topic, definition)
            kept.append(topic.name)
        for raw in reader.raw_messages(kept):
            writer.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)
    return Repair(writer.directory, writer.message_count, len(kept), (*reader.notes, *notes))


def _free(base: Path) -> Path:
    """Return `base`, or the first of `base`_2, `base`_3, ... that does not exist."""
    candidate, number = base, 2
    while os.path.exists(candidate):
        candidate = base.with_name(f"{base.name}_{number}")
        number += 1
    return candidate
