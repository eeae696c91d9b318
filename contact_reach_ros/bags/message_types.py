"""Message types: definitions for writing bags, and decoding by the definitions in a bag, without a ROS installation.

Bags are written with ROS's own types, which come from tables that are part of `rosbags`.
"""

from __future__ import annotations

import functools
import importlib
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from mcap.records import Schema
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from contact_reach_ros.bags.topics import CDR, ROS2MSG, RecordedTopic
from contact_reach_ros.errors import BagError

_UNCLEAR = (TypesysError, UnicodeDecodeError, KeyError, SyntaxError, RecursionError)
"""What rosbags raises for invalid definitions: it turns them into Python code, even if a name is no identifier or a
type contains itself."""
_UNDECODABLE = (SerdeError, struct.error, IndexError, ValueError)
"""What rosbags raises for bytes that are no message of the type."""


@functools.cache
def _standard_types() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def standard_definition(name: str) -> tuple[bytes, str]:
    """The text of the .msg file followed by each dependency once, as in `ros2msg` schemas, and the hash of the type.

    It must be one of ROS 2 Jazzy's types, or one that is installed.
    """
    store = _standard_types()
    _learn(name)
    text, _ = store.generate_msgdef(name, ros_version=2)
    return text.encode(), store.hash_rihs01(name)


def message_class(name: str) -> Any:
    """Return the class of a message type, such as sensor_msgs/msg/JointState; None if it is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except (ImportError, TypeError, ValueError):
        return None


_LIST = re.compile(r"sequence<(?P<of>.+?)(?:, (?P<most>\d+))?>|(?P<item>.+)\[(?P<length>\d+)\]")
_IDL = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}
"""Names of types in message classes that differ from those in .msg files."""


def _learn(name: str) -> None:
    """Define a type that is not ROS's own by the fields of its installed class, which has no constants."""
    if name in _standard_types().fielddefs:
        return
    lines = []
    for field, kind in message_class(name).get_fields_and_field_types().items():
        found, size = _LIST.fullmatch(kind), ""
        if found:
            kind = found["of"] or found["item"]
            size = f"[{found['length'] or (found['most'] and '<=' + found['most']) or ''}]"
        if "/" in kind:
            _learn(kind.replace("/", "/msg/"))
        lines.append(f"{_IDL.get(kind, kind).replace('<', '<=').replace('>', '')}{size} {field}")
    _standard_types().register(get_types_from_msg("\n".join(lines), name))


class Decoder:
    """Decodes messages, and keeps account of topics and messages for which that fails.

    Parameters
    ----------
    topics :
        The topics of the bag by name.
    schemas :
        Definitions of types by name, as far as the bag has them.
    """

    def __init__(self, topics: Mapping[str, RecordedTopic], schemas: Mapping[str, Schema]) -> None:
        self._topics, self._schemas = topics, schemas
        self._store = get_typestore(Stores.EMPTY)
        self._compiled: dict[str, Any] = {}
        self._left_out: dict[str, BagError] = {}
        self._undecoded: Counter[str] = Counter()

    def decode(self, topic: str, data: bytes) -> Any:
        """Decode a message; returns None if that fails, which `notes` reports afterwards."""
        if topic not in self._compiled:
            try:
                self._compiled[topic] = self._compile(self._topics[topic])
            except BagError as error:
                self._compiled[topic], self._left_out[topic] = None, error
        definition = self._compiled[topic]
        if definition is None:
            return None
        # Not by `deserialize_cdr`, which refuses bytes after the end: rclpy's `serialize_message` leaves up to eight.
        try:
            little_endian = data[1] & 1
            decode = definition.deserialize_cdr_le if little_endian else definition.deserialize_cdr_be
            return decode(data[4:], 0, definition.cls, self._store)[0]
        except _UNDECODABLE:
            self._undecoded[topic] += 1
            return None

    def notes(self) -> Iterator[str]:
        """Yield one sentence about each topic of which messages could not be decoded."""
        for topic, reason in self._left_out.items():
            yield f"topic '{topic}' is left out: {reason}"
        for topic, count in self._undecoded.items():
            yield f"topic '{topic}': {count} messages are no {self._topics[topic].type} and left out"

    def _compile(self, topic: RecordedTopic) -> Any:
        if topic.encoding != CDR:
            raise BagError(f"is serialised as {topic.encoding or 'nothing known'}, expected {CDR}")
        definition = self._schemas.get(topic.type)
        if definition is None:
            raise BagError(f"the bag has no definition of the type '{topic.type}'")
        if definition.encoding != ROS2MSG:
            raise BagError(
                f"type '{topic.type}' has a definition in the encoding '{definition.encoding}', expected {ROS2MSG}"
            )
        try:
            if topic.type not in self._store.fielddefs:
                self._store.register(get_types_from_msg(definition.data.decode(), topic.type))
            # This also shows whether a dependency is missing.
            return self._store.get_msgdef(topic.type)
        except _UNCLEAR as error:
            raise BagError(f"type '{topic.type}' has no clear definition: {error}") from error
