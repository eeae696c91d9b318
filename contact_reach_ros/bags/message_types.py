"""Message types: definitions for writing bags, and decoding by the definitions in a bag, without a ROS installation.

The standard types come from tables that are part of `rosbags`. Other types are read from the .msg files of the sourced
workspaces (AMENT_PREFIX_PATH).
"""

from __future__ import annotations

import os
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from contact_reach_ros.bags.topics import CDR, ROS2MSG, RecordedTopic, TypeDefinition, check_type_name
from contact_reach_ros.errors import BagError

_UNCLEAR = (TypesysError, UnicodeDecodeError, KeyError, SyntaxError, RecursionError)
"""What rosbags raises for invalid definitions: it turns them into Python code, even if a name is no identifier or a
type contains itself."""
_UNDECODABLE = (SerdeError, struct.error, IndexError, ValueError)
"""What rosbags raises for bytes that are no message of the type."""


class MessageTypes:
    """Looks up message definitions by type name."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)

    def definition(self, name: str) -> TypeDefinition:
        """Return the text of the .msg file followed by each dependency once, as in `ros2msg` schemas.

        Raises `BagError` if the type is neither a standard type nor in a sourced workspace.
        """
        self._register(name)
        text, _ = self._store.generate_msgdef(name, ros_version=2)
        return TypeDefinition(ROS2MSG, text.encode(), self._store.hash_rihs01(name))

    def _register(self, name: str) -> None:
        """Read the type and its dependencies from the sourced workspaces, unless they are known."""
        if check_type_name(name) in self._store.fielddefs:
            return
        path = _definition_path(name)
        try:
            found = get_types_from_msg(path.read_text(encoding="utf-8"), name)
        except TypesysError as error:
            raise BagError(f"{path}: not a message definition that can be read: {error}") from error
        for _, description in found[name][1]:
            for nested in _nested_types(description):
                self._register(nested)
        self._store.register(found)


class Decoder:
    """Decodes messages, and keeps account of topics and messages for which that fails.

    Parameters
    ----------
    topics :
        The topics of the bag by name.
    definition :
        Returns the definition of a type; raises `BagError` if the bag has none.
    """

    def __init__(self, topics: Mapping[str, RecordedTopic], definition: Callable[[str], TypeDefinition]) -> None:
        self._topics = topics
        self._definition = definition
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
        definition = self._definition(topic.type)
        if definition.encoding != ROS2MSG:
            raise BagError(
                f"type '{topic.type}' has a definition in the encoding '{definition.encoding}', expected {ROS2MSG}"
            )
        try:
            if topic.type not in self._store.fielddefs:
                self._store.register(get_types_from_msg(definition.text.decode(), topic.type))
            # This also shows whether a dependency is missing.
            return self._store.get_msgdef(topic.type)
        except _UNCLEAR as error:
            raise BagError(f"type '{topic.type}' has no clear definition: {error}") from error


def _definition_path(name: str) -> Path:
    package, _, type_name = check_type_name(name).split("/")
    prefixes = [prefix for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    for prefix in [*prefixes, sys.prefix]:
        path = Path(prefix) / "share" / package / "msg" / f"{type_name}.msg"
        if path.is_file():
            return path
    raise BagError(
        f"message type '{name}' is unknown: it is no standard type of ROS 2 Jazzy and share/{package}/msg/"
        f"{type_name}.msg is in none of the sourced workspaces; source the workspace that has it"
    )


def _nested_types(description: FieldDesc) -> Iterator[str]:
    if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        description = description[1][0]
    if description[0] == Nodetype.NAME:
        yield str(description[1])
