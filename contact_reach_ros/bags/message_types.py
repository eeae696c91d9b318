"""Message types: definitions for writing bags, and decoding, without a ROS installation.

ROS's own types come from tables that are part of `rosbags`.
"""

from __future__ import annotations

import functools
import re
import struct
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from contact_reach_ros.messages.topics import message_class


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


def decode(name: str, data: bytes) -> Any:
    """Decode a message in CDR of one of ROS 2 Jazzy's types; None if it is none.

    What a bag itself says of a type is not used: rosbags would turn it into Python code and execute that.
    """
    store = _standard_types()
    # Not by its `deserialize_cdr`, which refuses bytes after the end: rclpy's `serialize_message` leaves up to eight.
    try:
        definition = store.get_msgdef(name)
        read = definition.deserialize_cdr_le if data[1] & 1 else definition.deserialize_cdr_be
        return read(data[4:], 0, definition.cls, store)[0]
    except (KeyError, SerdeError, struct.error, IndexError, ValueError):
        return None
