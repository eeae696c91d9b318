"""Writing rosbag2 directories with mcap storage, readable by `ros2 bag`, without a ROS installation."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.writer import CompressionType, Writer

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording import bag_metadata
from contact_reach_ros.recording.message_types import MessageTypes
from contact_reach_ros.recording.topics import Topic

COMPRESSIONS: Mapping[str, CompressionType] = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD}
# Larger chunks compress no better for these messages, and each stalls the writing thread for longer.
CHUNK_BYTES = 256 * 1024


@dataclasses.dataclass
class _Channel:
    topic: Topic
    channel_id: int
    type_hash: str
    message_count: int = 0


class BagWriter:
    """A bag that is being written: a directory with metadata.yaml and one mcap file.

    To be used from one thread. Leaving the `with` block, or `close`, completes the bag; what was flushed
    before a crash can be read all the same.

    Parameters
    ----------
    directory :
        The bag to create; its parents are made as needed. It must not exist.
    topics :
        Topics known from the start; more can be added at any time.
    compression :
        "zstd" or "none", applied to each chunk of the file.
    custom_data :
        Text to keep in the bag, such as scene and seed.

    Raises
    ------
    BagError
        If the directory exists or cannot be written, a type is unknown, or a parameter is not accepted.
    """

    def __init__(
        self,
        directory: Path | str,
        topics: Iterable[Topic] = (),
        *,
        compression: str = "zstd",
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise BagError(f"bag compression '{compression}': expected one of {', '.join(COMPRESSIONS)}")
        self._directory = Path(directory)
        self._custom_data: dict[str, str] = {}
        for key, value in (custom_data or {}).items():
            self.set_custom_data(key, value)
        self._types = MessageTypes()
        self._channels: dict[str, _Channel] = {}
        self._schema_ids: dict[str, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        self._closed = False
        try:
            self._directory.mkdir(parents=True)
            self._stream = self.file.open("xb")
        except FileExistsError as error:
            raise BagError(
                f"bag '{self._directory}' exists and is not overwritten; choose another name or remove it"
            ) from error
        except OSError as error:
            raise BagError(f"bag '{self._directory}' cannot be created: {error.strerror}") from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=COMPRESSIONS[compression])
        self._writer.start(profile="ros2", library="contact_reach_ros")
        # A first copy, so that scene and seed are known even if the recording is cut.
        self._add_information()
        for topic in topics:
            self.add_topic(topic)
        self.flush()

    @property
    def directory(self) -> Path:
        """The bag."""
        return self._directory

    @property
    def file(self) -> Path:
        """The mcap file of the bag."""
        return self._directory / f"{self._directory.resolve().name}_0.mcap"

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(channel.message_count for channel in self._channels.values())

    def set_custom_data(self, key: str, value: str) -> None:
        """Keep a line of text in the bag, replacing an earlier one of the same key.

        Raises
        ------
        BagError
            If key or value is no text.
        """
        if not isinstance(key, str) or not isinstance(value, str):
            raise BagError(f"bag custom data {key!r} = {value!r}: expected text for both")
        self._custom_data[key] = value

    def add_topic(self, topic: Topic) -> None:
        """Prepare for the messages of one more topic.

        Raises
        ------
        BagError
            If the topic is in the bag already, its type is unknown, or the bag is closed.
        """
        if self._closed:
            raise BagError(f"bag '{self._directory}' is closed: topic '{topic.name}' cannot be added")
        if topic.name in self._channels:
            raise BagError(f"bag '{self._directory}': topic '{topic.name}' is added twice")
        schema_id = self._schema_ids.get(topic.type)
        if schema_id is None:
            definition = self._types.definition(topic.type)
            schema_id = self._writer.register_schema(topic.type, "ros2msg", definition.encode())
            self._schema_ids[topic.type] = schema_id
        type_hash = self._types.type_hash(topic.type)
        offered_qos = bag_metadata.dump_yaml([qos.as_mapping() for qos in topic.offered_qos])
        channel_id = self._writer.register_channel(
            topic.name,
            "cdr",
            schema_id,
            {"offered_qos_profiles": offered_qos, "topic_type_hash": type_hash},
        )
        self._channels[topic.name] = _Channel(topic, channel_id, type_hash)

    def write(
        self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int | None = None, sequence: int = 0
    ) -> None:
        """Append a message.

        Parameters
        ----------
        topic :
            Name of a topic that was added.
        data :
            The message, serialised as CDR with its 4-byte header.
        log_time_ns, publish_time_ns :
            Time of reception and of sending, ns since the epoch; sending defaults to reception.
        sequence :
            The number that the publisher gave the message, 0 if unknown.

        Raises
        ------
        BagError
            If the topic was not added, the bag is closed or the disk refuses.
        """
        channel = self._channels.get(topic)
        sequence &= 0xFFFFFFFF
        if channel is None or self._closed:
            reason = "it is closed" if self._closed else "add the topic first"
            raise BagError(f"bag '{self._directory}' cannot take a message of '{topic}': {reason}")
        if publish_time_ns is None:
            publish_time_ns = log_time_ns
        try:
            self._writer.add_message(channel.channel_id, log_time_ns, data, publish_time_ns, sequence)
        except OSError as error:
            raise self._refused(error) from error
        channel.message_count += 1
        if self._first_ns is None or log_time_ns < self._first_ns:
            self._first_ns = log_time_ns
        if log_time_ns > self._last_ns:
            self._last_ns = log_time_ns

    def flush(self) -> None:
        """Hand everything written so far to the operating system, so that killing the process cannot lose it.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        if self._closed:
            return
        try:
            self._writer.flush()
        except OSError as error:
            raise self._refused(error) from error

    def close(self) -> None:
        """Complete the bag: index, summary and metadata.yaml. Does nothing when it is closed already.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with self._stream:
                self._add_information()
                self._writer.finish()
            bag_metadata.write(self._directory, self._information())
        except OSError as error:
            raise self._refused(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _refused(self, error: OSError) -> BagError:
        return BagError(f"bag '{self._directory}' cannot be written: {error.strerror or error}")

    def _add_information(self) -> None:
        text = bag_metadata.dump_yaml(self._information())
        self._writer.add_metadata(bag_metadata.MCAP_NAME, {bag_metadata.MCAP_KEY: text})

    def _information(self) -> dict[str, Any]:
        first_ns = self._first_ns or 0
        topics = [
            bag_metadata.TopicCount(channel.topic, channel.type_hash, channel.message_count)
            for channel in self._channels.values()
        ]
        duration_ns = max(0, self._last_ns - first_ns)
        return bag_metadata.information(self.file.name, topics, first_ns, duration_ns, self._custom_data)


def new_bag_directory(base: Path | str) -> Path:
    """`base`, or the first of `base`_2, `base`_3, ... that does not exist."""
    base = Path(base)
    candidate, number = base, 2
    while candidate.exists():
        candidate = base.with_name(f"{base.name}_{number}")
        number += 1
    return candidate
