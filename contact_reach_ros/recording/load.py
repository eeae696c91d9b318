"""What `nodes/load.py` publishes, and how many of its messages are in a bag."""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

from contact_reach_ros.recording.bag_reader import BagReader

NAMESPACE = "/bench"

_STAMP = struct.Struct("<iI")
_NUMBER = struct.Struct("<d")
_HEADER_BYTES = 4
_DATA_START = 20
"""Of a Float64MultiArray without a layout: behind header, layout and the number of values, aligned."""
_COMMANDS = "effort_controller/commands"


@dataclasses.dataclass(frozen=True)
class Arrived:
    """What of the load is in a bag.

    Attributes
    ----------
    topics :
        How many of its topics.
    messages :
        Messages, each number of a topic counted once.
    missing :
        Numbers of messages that are missing.
    gaps :
        The same by the publishers' sequence numbers.
    """

    topics: int
    messages: int
    missing: int
    gaps: int


def count_arrived(bag: Path, ticks: int) -> Arrived:
    """Look for messages 0 to `ticks` - 1 on every topic below `NAMESPACE`.

    Raises
    ------
    BagError
        If the bag cannot be read.
    """
    reader = BagReader(bag)
    names = [name for name in reader.topics() if name.startswith(NAMESPACE)]
    numbers: dict[str, set[int]] = {name: set() for name in names}
    last: dict[str, int] = {}
    gaps = 0
    for raw in reader.raw_messages(names):
        numbers[raw.topic].add(_number(raw.data, raw.topic.endswith(_COMMANDS)))
        gaps += raw.sequence - last.get(raw.topic, raw.sequence - 1) - 1
        last[raw.topic] = raw.sequence
    arrived = sum(len(found & set(range(ticks))) for found in numbers.values())
    return Arrived(len(names), arrived, len(names) * ticks - arrived, gaps)


def _number(data: bytes, is_command: bool) -> int:
    """A message's number: its first value, or its stamp in ns."""
    if is_command:
        return int(_NUMBER.unpack_from(data, _DATA_START)[0])
    seconds, nanoseconds = _STAMP.unpack_from(data, _HEADER_BYTES)
    return int(seconds * 1_000_000_000 + nanoseconds)
