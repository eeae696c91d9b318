"""Writing rosbag2 directories with mcap storage, readable by `ros2 bag`, without a ROS installation."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import yaml
from mcap.writer import CompressionType, Writer

from contact_reach_ros.bags.message_types import standard_definition
from contact_reach_ros.bags.topics import MCAP_KEY, MCAP_NAME, ROS2MSG, RecordedTopic, written_qos
from contact_reach_ros.errors import BagError

CHUNK_BYTES = 2 * 1024 * 1024
"""More than a second of the stack, so that only `flush` ends a chunk. mcap keeps an index entry of about 1.5 kB for
each chunk in memory until the file is closed: with two chunks a second, 2 MB in ten minutes."""
METADATA, INFORMATION = "metadata.yaml", "rosbag2_bagfile_information"
"""File of a bag, and its key."""
VERSION, ROS_DISTRO = 9, "jazzy"
"""Of the metadata."""


@dataclasses.dataclass
class _Channel:
    topic: RecordedTopic
    type_hash: str
    number: int
    message_count: int = 0


class BagWriter:
    """A bag that is being written: a directory with metadata.yaml and one mcap file.

    Use it from one thread. Leaving the `with` block, or `close`, completes the bag; after a crash, what was flushed
    can still be read. Raises `BagError` if the directory exists or cannot be written.

    Parameters
    ----------
    directory :
        The bag to create; its parents are made as needed. It must not exist.
    topics :
        Topics known from the start; more can be added at any time.
    custom_data :
        Text to store in the bag, such as scene and seed.

    Attributes
    ----------
    directory :
        The bag.
    """

    def __init__(
        self,
        directory: Path | str,
        topics: Iterable[RecordedTopic] = (),
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        self.directory = Path(directory)
        self._custom_data = dict(custom_data or {})
        self._custom_data_written = True
        self._channels: dict[str, _Channel] = {}
        self._schema_ids: dict[str, int] = {}
        self._file = f"{self.directory.resolve().name}_0.mcap"
        self._span_ns: tuple[int, int] | None = None
        self._closed = False
        # One thread, since a disk may keep a caller waiting for long.
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="disk")
        self._syncing: Future[None] | None = None
        try:
            self.directory.mkdir(parents=True)
            self._stream = (self.directory / self._file).open("xb")
            _sync_directory(self.directory)
            # Half the size for a tenth more work.
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library="contact_reach_ros")
            # A first copy, so that scene and seed are there even if the recording is cut.
            self._add_information()
        except FileExistsError as error:
            raise BagError(
                f"bag '{self.directory}' exists and is not overwritten; choose another name or remove it"
            ) from error
        except OSError as error:
            raise BagError(f"bag '{self.directory}' cannot be created: {error.strerror}") from error
        for topic in topics:
            self.add_topic(topic)

    @property
    def message_count(self) -> int:
        """Number of messages written so far."""
        return sum(channel.message_count for channel in self._channels.values())

    def set_custom_data(self, key: str, value: str) -> None:
        """Store text in the bag, replacing an earlier one of the same key; the next `flush` writes it."""
        if self._custom_data.get(key) != value:
            self._custom_data[key] = value
            self._custom_data_written = False

    def add_topic(self, topic: RecordedTopic) -> None:
        """Add a topic of ROS's own types, or of an installed one; its messages can be written from now on."""
        text, type_hash = standard_definition(topic.type)
        if topic.type not in self._schema_ids:
            self._schema_ids[topic.type] = self._writer.register_schema(topic.type, ROS2MSG, text)
        profiles = _dump_yaml(written_qos(topic))
        about = {"offered_qos_profiles": profiles, "topic_type_hash": type_hash}
        number = self._writer.register_channel(topic.name, topic.encoding, self._schema_ids[topic.type], about)
        self._channels[topic.name] = _Channel(topic, type_hash, number)

    def write(
        self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int | None = None, sequence: int = 0
    ) -> None:
        """Append a message; raises `BagError` if it cannot be written.

        Parameters
        ----------
        topic :
            Name of a topic that was added.
        data :
            The message, serialised as CDR with its 4-byte header.
        log_time_ns, publish_time_ns :
            Times of reception and of sending, ns since the epoch; sending defaults to reception.
        sequence :
            The publisher's number of the message, 0 if unknown.
        """
        channel = self._channels[topic]
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        try:
            self._writer.add_message(channel.number, log_time_ns, data, publish_time_ns, sequence & 0xFFFFFFFF)
        except OSError as error:
            raise self._refused(error) from error
        channel.message_count += 1
        first_ns, last_ns = self._span_ns or (log_time_ns, log_time_ns)
        self._span_ns = min(first_ns, log_time_ns), max(last_ns, log_time_ns)

    def flush(self) -> None:
        """Pass everything written so far to the operating system, so that it survives if the process is killed.

        It also starts to write to the disk, so that it survives a power cut; that finishes after the call returns.
        Raises `BagError` if either fails, the disk by the next call.
        """
        try:
            if not self._custom_data_written:
                self._add_information()
            self._writer.flush()
            if self._syncing is None or self._syncing.done():
                self._wait_for_disk()
                self._syncing = self._disk.submit(os.fdatasync, self._stream.fileno())
        except OSError as error:
            raise self._refused(error) from error

    def close(self) -> None:
        """Complete the bag with index, summary and metadata.yaml; does nothing if it is already closed.

        Raises `BagError` if the bag cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with self._stream:
                self._wait_for_disk()
                self._add_information()
                self._writer.finish()
                self._stream.flush()
                os.fdatasync(self._stream.fileno())
            with (self.directory / METADATA).open("w", encoding="utf-8") as metadata:
                metadata.write(_dump_yaml({INFORMATION: self._information()}))
                metadata.flush()
                os.fsync(metadata.fileno())
            _sync_directory(self.directory)
        except OSError as error:
            raise self._refused(error) from error
        finally:
            self._disk.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for_disk(self) -> None:
        """Wait for the last `flush` to reach the disk; raises its error."""
        syncing, self._syncing = self._syncing, None
        if syncing is not None:
            syncing.result()

    def _refused(self, error: OSError) -> BagError:
        return BagError(f"bag '{self.directory}' cannot be written: {error.strerror or error}")

    def _add_information(self) -> None:
        self._writer.add_metadata(MCAP_NAME, {MCAP_KEY: _dump_yaml(self._information())})
        self._custom_data_written = True

    def _information(self) -> dict[str, Any]:
        """What rosbag2 keeps about a bag of one mcap file."""
        first_ns, last_ns = self._span_ns or (0, 0)
        span = {
            "duration": {"nanoseconds": last_ns - first_ns},
            "starting_time": {"nanoseconds_since_epoch": first_ns},
            "message_count": self.message_count,
        }
        return {
            "version": VERSION,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": channel.topic.name,
                        "type": channel.topic.type,
                        "serialization_format": channel.topic.encoding,
                        "offered_qos_profiles": written_qos(channel.topic),
                        "type_description_hash": channel.type_hash,
                    },
                    "message_count": channel.message_count,
                }
                for channel in self._channels.values()
            ],
            # These two concern whole messages or files, not chunks inside an mcap file.
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file],
            "files": [{"path": self._file, **span}],
            "custom_data": self._custom_data or None,
            "ros_distro": ROS_DISTRO,
        }


class _PlainDumper(yaml.SafeDumper):
    """Writes no anchors, which not every reader of bags understands."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _dump_yaml(content: Any) -> str:
    return yaml.dump(content, Dumper=_PlainDumper, sort_keys=False)


def _sync_directory(directory: Path) -> None:
    """Flush the names in a directory to the disk, so that they survive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
