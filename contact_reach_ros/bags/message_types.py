"""Definitions and hashes of message types.

The standard types come from tables that are part of `rosbags`, so bags can be written without a ROS
installation. Other types are read from the .msg files of the sourced workspaces (AMENT_PREFIX_PATH).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from contact_reach_ros.bags.topics import check_type_name
from contact_reach_ros.errors import BagError


class MessageTypes:
    """Looks up message definitions by type name."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)

    def definition(self, name: str) -> str:
        """Return the text of the .msg file followed by each dependency once, as in `ros2msg` schemas.

        Raises `BagError` if the type is neither a standard type nor in a sourced workspace.
        """
        self._require(name)
        text, _ = self._store.generate_msgdef(name, ros_version=2)
        return text

    def type_hash(self, name: str) -> str:
        """Return the hash of the type in the form RIHS01_<64 hexadecimal digits>.

        Raises
        ------
        BagError
            See `definition`.
        """
        self._require(name)
        return self._store.hash_rihs01(name)

    def _require(self, name: str) -> None:
        if check_type_name(name) not in self._store.fielddefs:
            self._store.register(self._read_with_dependencies(name))

    def _read_with_dependencies(self, name: str) -> Typesdict:
        found: Typesdict = {}
        missing = [name]
        while missing:
            current = missing.pop()
            path = _definition_path(current)
            try:
                found.update(get_types_from_msg(path.read_text(encoding="utf-8"), current))
            except TypesysError as error:
                raise BagError(f"{path}: not a message definition that can be read: {error}") from error
            for _, description in found[current][1]:
                missing.extend(
                    nested
                    for nested in _nested_types(description)
                    if nested not in found and nested not in self._store.fielddefs
                )
        return found


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
