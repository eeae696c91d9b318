"""Reading rosbag2 directories with mcap storage, or single mcap files, without a ROS installation."""

from __future__ import annotations

import dataclasses
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from mcap.records import Channel, Schema
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording import bag_metadata
from contact_reach_ros.recording.mcap_file import PROFILE, McapFile
from contact_reach_ros.recording.topics import CDR, ROS2MSG, OfferedQos, TypeDefinition, read_offered_qos
from contact_reach_ros.units import NANOSECONDS

_UNCLEAR = (TypesysError, UnicodeDecodeError, KeyError, SyntaxError, RecursionError)
"""What rosbags raises for definitions that are none: it makes Python code of them, also where names are no names, or a
type contains itself."""


class RawMessage(NamedTuple):
    """A message as it was received: serialised, with its times in ns since the epoch and its publisher's number."""

    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes
    sequence: int


class BagMessage(NamedTuple):
    """A decoded message (fields by attribute, number sequences as arrays), times in ns since the epoch."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    message: Any


@dataclasses.dataclass(frozen=True)
class RecordedTopic:
    """A topic of a bag: its type, the number of its messages, what its publishers offered, and how it is serialised."""

    name: str
    type: str
    message_count: int
    offered_qos: tuple[OfferedQos, ...] = ()
    encoding: str = CDR


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
        information = self._read_information() if self._path.is_dir() else None
        self._files = self._open(self._find_files(information))
        self._times: list[dict[int, np.ndarray]] | None = None
        self._decodable: set[str] = set()
        self._unreadable: dict[str, str] = {}
        self._undecoded: Counter[str] = Counter()
        self._first_error: dict[str, str] = {}
        self._store = get_typestore(Stores.EMPTY)
        self._registered: set[str] = set()
        self.summary = self._summarise(information)

    @property
    def notes(self) -> tuple[str, ...]:
        """Those of the summary, and what has been found since then: damaged chunks, messages that are none."""
        damaged = [
            f"{file.path.name}: {file.damaged_chunks} chunks are damaged, their messages are left out"
            for file in self._files
            if file.damaged_chunks
        ]
        undecoded = [
            f"topic '{topic}': {count} messages are no {self.topics()[topic].type} and left out;"
            f" {self._first_error[topic]}"
            for topic, count in self._undecoded.items()
        ]
        found = [*damaged, *self._unreadable.values(), *undecoded]
        return (*self.summary.notes, *(note for note in found if note not in self.summary.notes))

    def topics(self) -> Mapping[str, RecordedTopic]:
        """The topics of the bag by name."""
        return self.summary.topics

    def indexed_files(self) -> list[Path]:
        """Its mcap files, if all are complete and have an index; else none."""
        indexed = all(file.contents.indexed for file in self._files)
        return [file.path for file in self._files] if indexed else []

    def raw_messages(self, topics: Collection[str] | None = None, start_ns: int = 0) -> Iterator[RawMessage]:
        """Messages of some topics, or of all, as they were received, from a time of reception on.

        They come by time of reception; from a cut file in the order in which they were written. What lies in damaged
        chunks is left out, which `notes` tells afterwards.

        Raises
        ------
        BagError
            If the bag has no such topic.
        """
        wanted = set(self.topics()) if topics is None else set(topics)
        missing = sorted(wanted - set(self.topics()))
        if missing:
            known = ", ".join(sorted(self.topics())) or "none"
            raise BagError(f"bag '{self._path}' has no topic '{missing[0]}'; it has {known}")
        types = {name: topic.type for name, topic in self.topics().items()}
        for file in self._files:
            for channel, message in file.messages(wanted, start_ns):
                name = channel.topic
                received, sent, _, sequence, data = message
                yield RawMessage(name, types[name], received, sent, data, sequence)

    @property
    def files(self) -> Sequence[McapFile]:
        """The files of the bag, in their order."""
        return self._files

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages of some topics, or of all, decoded by the definitions that the bag itself holds.

        Topics and messages that cannot be decoded are left out, which `notes` tells afterwards.

        Raises
        ------
        BagError
            If the bag has no such topic.
        """
        for raw in self.raw_messages(topics):
            decoded = self.decode(raw)
            if decoded is not None:
                yield BagMessage(raw.topic, raw.log_time_ns, raw.publish_time_ns, decoded)

    def decode(self, raw: RawMessage) -> Any:
        """One message decoded; None if that cannot be done, which `notes` tells afterwards."""
        if raw.topic in self._unreadable or not self._readable(raw.topic, raw.type):
            return None
        try:
            return self._decode(raw.data, raw.type)
        except (SerdeError, struct.error, IndexError, ValueError) as error:
            self._undecoded[raw.topic] += 1
            self._first_error.setdefault(raw.topic, f"the first was received at {raw.log_time_ns} ns: {error}")
            return None

    def reception_times(self, topic: str) -> np.ndarray:
        """(n,) ns since the epoch, in the order of the file, without reading messages where there is an index.

        Raises
        ------
        BagError
            If the bag has no such topic.
        """
        if topic not in self.topics():
            raise BagError(f"bag '{self._path}' has no topic '{topic}'")
        if self._times is None:
            self._times = [file.reception_times() for file in self._files]
        parts = [
            times[number]
            for file, times in zip(self._files, self._times, strict=True)
            for number, channel in file.contents.channels.items()
            if channel.topic == topic and number in times
        ]
        return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)

    def definition(self, type_name: str) -> TypeDefinition:
        """The definition of a type that the bag holds.

        Raises
        ------
        BagError
            If it holds none.
        """
        schema = self._schema(type_name)
        if schema is None:
            raise BagError(f"bag '{self._path}' has no definition of the type '{type_name}'")
        hashes = (
            channel.metadata.get("topic_type_hash", "")
            for file in self._files
            for channel in file.contents.channels.values()
            if channel.schema_id in file.contents.schemas and file.contents.schemas[channel.schema_id].name == type_name
        )
        return TypeDefinition(schema.encoding, schema.data, next(filter(None, hashes), ""))

    def _readable(self, topic: str, type_name: str) -> bool:
        """Whether the messages of a topic can be decoded; the reason why not is kept."""
        if topic in self._decodable:
            return True
        encoding = self.topics()[topic].encoding
        try:
            if encoding != CDR:
                raise BagError(f"is serialised as {encoding or 'nothing known'}, expected {CDR}")
            if type_name not in self._registered:
                self._register(type_name)
        except BagError as error:
            self._unreadable[topic] = f"topic '{topic}' is left out: {error}"
            return False
        self._decodable.add(topic)
        return True

    def _decode(self, data: bytes, type_name: str) -> Any:
        # Not by `deserialize_cdr`, which refuses bytes after the end: rclpy's `serialize_message` leaves up to eight.
        definition = self._store.get_msgdef(type_name)
        little_endian = data[1] & 1
        decode = definition.deserialize_cdr_le if little_endian else definition.deserialize_cdr_be
        return decode(data[4:], 0, definition.cls, self._store)[0]

    def _read_information(self) -> Mapping[str, Any] | None:
        try:
            information = bag_metadata.read(self._path)
        except BagError as error:
            if not any(self._path.glob("*.mcap")):
                raise
            self._notes.append(f"{error}; the mcap files are read without it")
            return None
        if information is None and any(self._path.glob("*.mcap")):
            self._notes.append(
                "metadata.yaml is missing: the recording was not closed; `contact-reach bag repair` closes it"
            )
        return information

    def _open(self, paths: Sequence[Path]) -> list[McapFile]:
        """The files that can be read; one that cannot is noted if there are others."""
        files, errors = [], []
        for path in paths:
            try:
                files.append(McapFile(path))
            except BagError as error:
                errors.append(error)
        if errors and not files:
            raise errors[0]
        self._notes += [str(error) for error in errors]
        return files

    def _find_files(self, information: Mapping[str, Any] | None) -> list[Path]:
        if not self._path.is_dir():
            return [self._path]
        if information is None:
            files = sorted(self._path.glob("*.mcap"), key=_file_number)
            if not files:
                raise BagError(f"'{self._path}' is no bag: it has neither metadata.yaml nor an mcap file")
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
            contents = file.contents
            if contents.profile not in (None, PROFILE):
                self._notes.append(
                    f"{file.path.name} has the profile '{contents.profile}', expected '{PROFILE}':"
                    " it may be no recording of ROS 2"
                )
            for number, channel in contents.channels.items():
                schema = contents.schemas.get(channel.schema_id)
                found = self._topic(channel, schema, contents.message_counts.get(number, 0))
                known = topics.setdefault(channel.topic, dataclasses.replace(found, message_count=0))
                if known.type != found.type:
                    raise BagError(
                        f"{file.path}: topic '{channel.topic}' has both type {known.type} and {found.type},"
                        " expected one"
                    )
                count = known.message_count + found.message_count
                topics[channel.topic] = dataclasses.replace(known, message_count=count)
            if contents.cut_at is not None:
                self._notes.append(
                    f"{file.path.name} is cut or damaged: readable up to byte {contents.cut_at}"
                    f" of {file.path.stat().st_size}"
                )
            if file.damaged_chunks:
                self._notes.append(
                    f"{file.path.name}: {file.damaged_chunks} chunks are damaged, their messages are left out"
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

    def _topic(self, channel: Channel, schema: Schema | None, message_count: int) -> RecordedTopic:
        try:
            offered_qos = read_offered_qos(channel.metadata.get("offered_qos_profiles", ""))
        except BagError as error:
            self._notes.append(f"topic '{channel.topic}': {error}")
            offered_qos = ()
        type_name = schema.name if schema else ""
        return RecordedTopic(channel.topic, type_name, message_count, offered_qos, channel.message_encoding)

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
        if schema is None or schema.encoding != ROS2MSG:
            encoding = schema.encoding if schema else "none"
            raise BagError(f"type '{type_name}' has a definition in the encoding '{encoding}', expected {ROS2MSG}")
        try:
            self._store.register(get_types_from_msg(schema.data.decode(), type_name))
            # Compiles the decoder, which shows whether a dependency is missing.
            self._store.get_msgdef(type_name)
        except _UNCLEAR as error:
            raise BagError(f"type '{type_name}' has no clear definition: {error}") from error
        self._registered.add(type_name)

    def _schema(self, type_name: str) -> Schema | None:
        schemas = (schema for file in self._files for schema in file.contents.schemas.values())
        return next((schema for schema in schemas if schema.name == type_name), None)


def _file_number(path: Path) -> tuple[int, str]:
    """Order of the files of a split bag: by the number at the end of the name."""
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdigit() else 0, path.name)
