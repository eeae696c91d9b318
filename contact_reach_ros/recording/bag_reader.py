"""Reading rosbag2 directories with mcap storage, or single mcap files, without a ROS installation."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.records import Schema
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording import bag_metadata
from contact_reach_ros.recording.mcap_file import McapFile
from contact_reach_ros.units import NANOSECONDS


class RawMessage(NamedTuple):
    """A message as it was received: serialised, with its times in ns since the epoch."""

    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class BagMessage(NamedTuple):
    """A decoded message (fields by attribute, number sequences as arrays), times in ns since the epoch."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    message: Any


@dataclasses.dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag, its type and the number of its messages."""

    name: str
    type: str
    message_count: int


@dataclasses.dataclass(frozen=True)
class BagSummary:
    """What a bag holds.

    Attributes
    ----------
    path :
        The bag.
    topics :
        By name.
    start_ns :
        Reception of the first message, ns since the epoch; 0 without messages.
    duration :
        From the first to the last message, s.
    custom_data :
        Text that was kept with the recording.
    notes :
        What is wrong with the bag though it can be read, one sentence each; empty for a complete one.
    """

    path: Path
    topics: Mapping[str, RecordedTopic]
    start_ns: int
    duration: float
    custom_data: Mapping[str, str]
    notes: tuple[str, ...]

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(topic.message_count for topic in self.topics.values())


class BagReader:
    """A recorded bag: a directory as rosbag2 makes it, or one mcap file.

    Parameters
    ----------
    path :
        The bag.

    Raises
    ------
    BagError
        If it is missing, empty or no bag, or in a storage or compression other than mcap with its own.
    """

    def __init__(self, path: Path | str) -> None:
        self._path = Path(path)
        if not self._path.exists():
            raise BagError(f"bag '{self._path}' does not exist")
        self._notes: list[str] = []
        information = bag_metadata.read(self._path) if self._path.is_dir() else None
        self._files = [McapFile(file) for file in self._find_files(information)]
        self._store = get_typestore(Stores.EMPTY)
        self._registered: set[str] = set()
        self.summary = self._summarise(information)

    def topics(self) -> Mapping[str, RecordedTopic]:
        """The topics of the bag by name."""
        return self.summary.topics

    def raw_messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of some topics, or of all, as they were received.

        They come by time of reception; from a cut file in the order in which they were written.

        Raises
        ------
        BagError
            If the bag has no such topic or is damaged.
        """
        wanted = set(self.topics()) if topics is None else set(topics)
        missing = sorted(wanted - set(self.topics()))
        if missing:
            known = ", ".join(sorted(self.topics())) or "none"
            raise BagError(f"bag '{self._path}' has no topic '{missing[0]}'; it has {known}")
        for file in self._files:
            for channel, message in file.messages(wanted):
                type_name = self.topics()[channel.topic].type
                yield RawMessage(channel.topic, type_name, message.log_time, message.publish_time, message.data)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages of some topics, or of all, decoded by the definitions that the bag itself holds.

        Raises
        ------
        BagError
            If the bag has no such topic or is damaged, or a message does not fit its definition.
        """
        for raw in self.raw_messages(topics):
            if raw.type not in self._registered:
                self._register(raw.type)
            try:
                decoded = self._decode(raw.data, raw.type)
            except (SerdeError, struct.error, IndexError, ValueError) as error:
                raise BagError(
                    f"bag '{self._path}', topic '{raw.topic}', received at {raw.log_time_ns} ns: no {raw.type}: {error}"
                ) from error
            yield BagMessage(raw.topic, raw.log_time_ns, raw.publish_time_ns, decoded)

    def _decode(self, data: bytes, type_name: str) -> Any:
        # Not by `deserialize_cdr`, which refuses bytes after the end: rclpy's `serialize_message` leaves up to eight.
        definition = self._store.get_msgdef(type_name)
        little_endian = data[1] & 1
        decode = definition.deserialize_cdr_le if little_endian else definition.deserialize_cdr_be
        return decode(data[4:], 0, definition.cls, self._store)[0]

    def _find_files(self, information: Mapping[str, Any] | None) -> list[Path]:
        if not self._path.is_dir():
            return [self._path]
        if information is None:
            files = sorted(self._path.glob("*.mcap"))
            if not files:
                raise BagError(f"'{self._path}' is no bag: it has neither metadata.yaml nor an mcap file")
            self._notes.append("metadata.yaml is missing: the recording was not closed")
            return files
        storage = information.get("storage_identifier")
        if storage != "mcap":
            raise BagError(
                f"bag '{self._path}' is stored as {storage}, expected mcap; `ros2 bag convert` can convert it"
            )
        if information.get("compression_mode"):
            raise BagError(
                f"bag '{self._path}' is compressed by {information['compression_mode']}, expected none or"
                " that of mcap itself; `ros2 bag convert` can convert it"
            )
        names = information.get("relative_file_paths")
        if not isinstance(names, list) or not names:
            raise BagError(f"{self._path / bag_metadata.FILE_NAME}: names no file in relative_file_paths")
        return [self._path / Path(str(name)).name for name in names]

    def _summarise(self, information: Mapping[str, Any] | None) -> BagSummary:
        topics: dict[str, RecordedTopic] = {}
        for file in self._files:
            for number, channel in file.contents.channels.items():
                schema = file.contents.schemas.get(channel.schema_id)
                type_name = schema.name if schema else ""
                counted = topics.get(channel.topic, RecordedTopic(channel.topic, type_name, 0))
                if counted.type != type_name:
                    raise BagError(
                        f"{file.path}: topic '{channel.topic}' has both type {counted.type} and {type_name},"
                        " expected one"
                    )
                count = counted.message_count + file.contents.message_counts.get(number, 0)
                topics[channel.topic] = dataclasses.replace(counted, message_count=count)
            if file.contents.cut_at is not None:
                self._notes.append(
                    f"{file.path.name} is cut or damaged: readable up to byte {file.contents.cut_at}"
                    f" of {file.path.stat().st_size}"
                )
        filled = [file.contents for file in self._files if any(file.contents.message_counts.values())]
        start_ns = min((contents.start_ns for contents in filled), default=0)
        end_ns = max((contents.end_ns for contents in filled), default=0)
        return BagSummary(
            self._path,
            topics,
            start_ns,
            (end_ns - start_ns) / NANOSECONDS,
            bag_metadata.custom_data(information or self._embedded_information()),
            tuple(self._notes),
        )

    def _embedded_information(self) -> Mapping[str, Any] | None:
        """The copy of the metadata in the last file that has one."""
        for file in reversed(self._files):
            text = file.contents.metadata.get(bag_metadata.MCAP_NAME, {}).get(bag_metadata.MCAP_KEY)
            if text is not None:
                try:
                    content = yaml.safe_load(text)
                except yaml.YAMLError as error:
                    self._notes.append(f"the metadata inside {file.path.name} cannot be read: {error}")
                    continue
                if isinstance(content, dict):
                    return content
        return None

    def _register(self, type_name: str) -> None:
        schema = self._schema(type_name)
        if schema is None or schema.encoding != "ros2msg":
            encoding = schema.encoding if schema else "none"
            raise BagError(
                f"bag '{self._path}': type '{type_name}' has a definition in the encoding '{encoding}',"
                " expected ros2msg"
            )
        try:
            self._store.register(get_types_from_msg(schema.data.decode(), type_name))
            # Compiles the decoder, which shows whether a dependency is missing.
            self._store.get_msgdef(type_name)
        except (TypesysError, UnicodeDecodeError, KeyError) as error:
            raise BagError(f"bag '{self._path}': type '{type_name}' has no clear definition: {error}") from error
        self._registered.add(type_name)

    def _schema(self, type_name: str) -> Schema | None:
        schemas = (schema for file in self._files for schema in file.contents.schemas.values())
        return next((schema for schema in schemas if schema.name == type_name), None)
