"""The files of a bag, and the namespace of the stack that they record."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from contact_reach_ros.bags import metadata as bag_metadata
from contact_reach_ros.bags.mcap_file import McapFile
from contact_reach_ros.errors import BagError

_STATES, _SAFETY = "/joint_states", "/safety_state"


def find_files(path: Path, information: Mapping[str, Any] | None) -> list[Path]:
    """The mcap files of a bag, by its metadata if it has any.

    Raises `BagError` if it has none, or is stored otherwise than in mcap files.
    """
    if not path.is_dir():
        return [path]
    if information is None:
        files = sorted(path.glob("*.mcap"), key=_file_number)
        if not files:
            raise BagError(f"'{path}' is no bag: it has neither metadata.yaml nor an mcap file")
        return files
    storage = information.get("storage_identifier")
    if storage != "mcap":
        raise BagError(f"bag '{path}' is stored as {storage}, expected mcap; `ros2 bag convert` can convert it")
    if information.get("compression_mode"):
        raise BagError(
            f"bag '{path}' is compressed by {information['compression_mode']}, expected none or"
            " that of mcap itself; `ros2 bag convert` can convert it"
        )
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not names:
        raise BagError(f"{path / bag_metadata.FILE_NAME}: names no file in relative_file_paths")
    return [path / Path(str(name)).name for name in names]


def leave_namespace(path: Path, files: Sequence[McapFile]) -> None:
    """Take the namespace of the joint states off all topics; raise `BagError` if there are several stacks."""
    names = {channel.topic for file in files for channel in file.contents.channels.values()}
    found = (name.removesuffix(_STATES) for name in names if name.endswith(_STATES))
    spaces = sorted(space for space in found if space + _SAFETY in names)
    if len(spaces) > 1:
        raise BagError(
            f"bag '{path}' has several stacks: {', '.join(space or '/' for space in spaces)}; expected one: "
            "record each with its own bring-up"
        )
    space = (spaces or [""])[0]
    for file in files if space else ():
        channels = file.contents.channels
        for number, channel in channels.items():
            if channel.topic.startswith(f"{space}/"):
                channels[number] = dataclasses.replace(channel, topic=channel.topic.removeprefix(space))


def _file_number(path: Path) -> tuple[int, str]:
    """Sort key for the files of a split bag: the number at the end of the name, then the name."""
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdigit() else 0, path.name)
