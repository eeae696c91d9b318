"""Making a long bag of a short one: the same real messages over and over, each time later."""

from __future__ import annotations

import struct
from pathlib import Path

from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.units import NANOSECONDS

_STAMP = struct.Struct("<iI")
_STAMP_START = 4
_STATES = "/joint_states"
_STAMPED = ("std_msgs/Header ", "builtin_interfaces/Time ")
"""What the definition of a type begins with whose messages begin with a stamp."""
_PERIOD_NS = 1_000_000


def repeat_bag(path: Path, output: Path, duration: float) -> int:
    """Repeat a bag until its joint states span some time; returns how often.

    Times of reception and sending and stamps at the beginning of messages move on; what lies deeper stays as it was.
    The arm jumps back to where it began at every repetition.

    Parameters
    ----------
    path :
        The bag.
    output :
        Directory to create.
    duration :
        Least time from the first to the last stamp of a joint state, s.

    Raises
    ------
    BagError
        If it has no joint states, or one of the bags cannot be read or written.
    """
    reader = BagReader(path)
    if _STATES not in reader.topics():
        raise BagError(f"bag '{path}' has no topic {_STATES}")
    messages = list(reader.raw_messages())
    stamps = [_stamp_ns(message) for message in messages if message.topic == _STATES]
    span_ns = max(stamps) - min(stamps) + _PERIOD_NS
    received_ns = max(raw.log_time_ns for raw in messages) - min(raw.log_time_ns for raw in messages) + _PERIOD_NS
    stamped = {
        topic.name
        for topic in reader.topics().values()
        if reader.definition(topic.type).text.decode().lstrip().startswith(_STAMPED)
    }
    count = max(1, -int(-duration * NANOSECONDS // span_ns))
    with BagWriter(output, custom_data=reader.summary.custom_data) as writer:
        for topic in reader.topics().values():
            writer.add_topic(topic, reader.definition(topic.type))
        for repetition in range(count):
            later_ns = repetition * received_ns
            for raw in messages:
                data = _moved(raw, repetition * span_ns) if raw.topic in stamped else raw.data
                writer.write(raw.topic, data, raw.log_time_ns + later_ns, raw.publish_time_ns + later_ns, raw.sequence)
    return count


def _stamp_ns(raw: RawMessage) -> int:
    seconds, nanoseconds = _STAMP.unpack_from(raw.data, _STAMP_START)
    return int(seconds * NANOSECONDS + nanoseconds)


def _moved(raw: RawMessage, later_ns: int) -> bytes:
    stamp = _STAMP.pack(*divmod(_stamp_ns(raw) + later_ns, NANOSECONDS))
    return raw.data[:_STAMP_START] + stamp + raw.data[_STAMP_START + _STAMP.size :]
