"""metadata.yaml of a rosbag2 directory."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from contact_reach_ros.bags.topics import CDR, RecordedTopic, written_qos
from contact_reach_ros.errors import BagError

VERSION = 9
ROS_DISTRO = "jazzy"
MCAP_NAME = "rosbag2"
MCAP_KEY = "serialized_metadata"
"""Record and key under which rosbag2 keeps a copy of the metadata inside the mcap file."""

_FILE_NAME = "metadata.yaml"
_ROOT = "rosbag2_bagfile_information"


@dataclasses.dataclass
class FileSpan:
    """A file of a bag: its name, the number of its messages, and the times of the first and the last, ns."""

    path: str
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


def information(
    file: FileSpan, topics: Iterable[tuple[RecordedTopic, str]], custom_data: Mapping[str, str]
) -> dict[str, Any]:
    """Return the metadata that rosbag2 keeps about a bag of one mcap file; topics come with the hash of their type."""
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        **_span(file),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": CDR,
                    "offered_qos_profiles": written_qos(topic.offered_qos),
                    "type_description_hash": type_hash,
                },
                "message_count": topic.message_count,
            }
            for topic, type_hash in topics
        ],
        # These two concern whole messages or files, not chunks inside an mcap file.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path],
        "files": [{"path": file.path, **_span(file)}],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ROS_DISTRO,
    }


def _span(file: FileSpan) -> dict[str, Any]:
    start_ns = file.start_ns or 0
    return {
        "duration": {"nanoseconds": max(0, file.end_ns - start_ns)},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": file.message_count,
    }


def write(directory: Path, content: Mapping[str, Any]) -> None:
    """Write metadata.yaml, and flush it to the disk."""
    with (directory / _FILE_NAME).open("w", encoding="utf-8") as stream:
        stream.write(dump_yaml({_ROOT: dict(content)}))
        stream.flush()
        os.fsync(stream.fileno())
    sync_directory(directory)


def sync_directory(directory: Path) -> None:
    """Flush the names in a directory to the disk, so that they survive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read(directory: Path) -> dict[str, Any]:
    """Read metadata.yaml of a bag; raises `BagError` if it is missing, no rosbag2 metadata, or cannot be read."""
    path, without = directory / _FILE_NAME, "the mcap files are read without it"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BagError(
            f"{_FILE_NAME} is missing: the recording was not closed; `contact-reach bag repair` closes it"
        ) from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise BagError(f"{path}: cannot be read: {error}; {without}") from error
    inner = content.get(_ROOT) if isinstance(content, dict) else None
    if not isinstance(inner, dict):
        raise BagError(f"{path}: expected the metadata of a rosbag2 bag, with the key '{_ROOT}'; {without}")
    return inner


def dump_yaml(content: Any) -> str:
    """Return YAML in the given order and without anchors, which not every reader of bags understands."""
    return yaml.dump(content, Dumper=_PlainDumper, sort_keys=False)


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True
