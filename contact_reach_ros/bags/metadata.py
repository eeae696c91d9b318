"""metadata.yaml of a rosbag2 directory."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.errors import BagError

FILE_NAME = "metadata.yaml"
VERSION = 9
ROS_DISTRO = "jazzy"
MCAP_NAME = "rosbag2"
MCAP_KEY = "serialized_metadata"
"""Record and key under which rosbag2 keeps a copy of the metadata inside the mcap file."""

_ROOT = "rosbag2_bagfile_information"


@dataclasses.dataclass(frozen=True)
class TopicCount:
    """A topic of a bag with the hash of its type and the number of messages written so far."""

    topic: RecordedTopic
    type_hash: str
    message_count: int


@dataclasses.dataclass
class FileSpan:
    """A file of a bag: its name, the number of its messages, and the times of the first and the last, ns."""

    name: str
    message_count: int = 0
    start_ns: int | None = None
    end_ns: int = 0

    def add(self, time_ns: int) -> None:
        """Count a message received at this time; messages may come in any order."""
        self.message_count += 1
        if self.start_ns is None or time_ns < self.start_ns:
            self.start_ns = time_ns
        if time_ns > self.end_ns:
            self.end_ns = time_ns

    def as_mapping(self) -> dict[str, Any]:
        """Return start, duration and count under rosbag2's names."""
        start_ns = self.start_ns or 0
        return {
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "duration": {"nanoseconds": max(0, self.end_ns - start_ns)},
            "message_count": self.message_count,
        }


def information(
    files: Sequence[FileSpan], topics: Sequence[TopicCount], custom_data: Mapping[str, str]
) -> dict[str, Any]:
    """Return the metadata that rosbag2 keeps about a bag of one or more mcap files."""
    filled = [file for file in files if file.start_ns is not None]
    whole = FileSpan(
        "",
        sum(file.message_count for file in files),
        min((file.start_ns for file in filled if file.start_ns is not None), default=None),
        max((file.end_ns for file in filled), default=0),
    ).as_mapping()
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": whole["duration"],
        "starting_time": whole["starting_time"],
        "message_count": whole["message_count"],
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": entry.topic.name,
                    "type": entry.topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [qos.as_mapping() for qos in entry.topic.offered_qos],
                    "type_description_hash": entry.type_hash,
                },
                "message_count": entry.message_count,
            }
            for entry in topics
        ],
        # These two concern whole messages or files, not chunks inside an mcap file.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": file.name, **file.as_mapping()} for file in files],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ROS_DISTRO,
    }


def write(directory: Path, content: Mapping[str, Any]) -> None:
    """Write metadata.yaml; the file is renamed into place once it is on the disk, so that it is always complete."""
    target = directory / FILE_NAME
    partial = target.with_suffix(".yaml.partial")
    with partial.open("w", encoding="utf-8") as stream:
        stream.write(dump_yaml({_ROOT: dict(content)}))
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, target)
    sync_directory(directory)


def sync_directory(directory: Path) -> None:
    """Flush the names in a directory to the disk, so that they survive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read(directory: Path) -> dict[str, Any] | None:
    """Read metadata.yaml of a bag; returns None if there is none, as after a killed recording.

    Raises `BagError` if the file is no rosbag2 metadata or cannot be read.
    """
    path = directory / FILE_NAME
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise BagError(f"{path}: cannot be read: {error}") from error
    inner = content.get(_ROOT) if isinstance(content, dict) else None
    if not isinstance(inner, dict):
        raise BagError(f"{path}: expected the metadata of a rosbag2 bag, with the key '{_ROOT}'")
    return inner


def custom_data(content: Mapping[str, Any] | None) -> dict[str, str]:
    """Return the text stored with a bag, by key; empty if there is none."""
    found = (content or {}).get("custom_data")
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}


def dump_yaml(content: Any) -> str:
    """Return YAML in the given order and without anchors, which not every reader of bags understands."""
    return yaml.dump(content, Dumper=_PlainDumper, sort_keys=False)


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True
