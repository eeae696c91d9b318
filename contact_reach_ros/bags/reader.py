"""Reading rosbag2 directories with mcap storage, or single mcap files, without a ROS installation."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from mcap.records import Channel, Schema

from contact_reach_ros.bags import metadata as bag_metadata
from contact_reach_ros.bags.decoder import Decoder
from contact_reach_ros.bags.files import find_files, leave_namespace
from contact_reach_ros.bags.mcap_file import PROFILE, McapFile
from contact_reach_ros.bags.topics import RecordedTopic, TypeDefinition, read_offered_qos
from contact_reach_ros.errors import BagError
from contact_reach_ros.units import NANOSECONDS

"""Topics that every stack has."""


class RawMessage(NamedTuple):
    """A serialised message, with times of reception and sending in ns since the epoch and its publisher's number."""

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
        Text stored with the recording.
    notes :
        Defects of the bag that do not prevent reading, one sentence each; empty for a complete bag.
    """

    path: Path
    topics: Mapping[str, RecordedTopic]
    start_ns: int
    duration: float
    custom_data: Mapping[str, str]
    notes: tuple[str, ...]

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())


class BagReader:
    """A recorded bag: a directory as rosbag2 makes it, or one mcap file.

    Raises `BagError` if it is missing, empty or no bag, or if it is not stored as mcap, or compressed by other means
    than mcap's own; with `of_stack` also if it has several stacks.

    Parameters
    ----------
    path :
        The bag.
    of_stack :
        Whether topics go without the namespace of the stack that was recorded.
    """

    def __init__(self, path: Path | str, of_stack: bool = False) -> None:
        self._path = Path(path)
        # Not Path.exists, which raises for a name that is too long.
        if not os.path.exists(self._path):
            raise BagError(f"bag '{self._path}' does not exist")
        self._notes: list[str] = []
        information = self._read_information() if self._path.is_dir() else None
        self._files = self._open(find_files(self._path, information))
        if of_stack:
            leave_namespace(self._path, self._files)
        self._times: list[dict[int, np.ndarray]] | None = None
        self.summary = self._summarise(information)
        self._decoder = Decoder(self.summary.topics, self.definition)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the summary, and those on damaged chunks and undecodable messages found since."""
        found = [*self._damages(), *self._decoder.notes()]
        return (*self.summary.notes, *(note for note in found if note not in self.summary.notes))

    def topics(self) -> Mapping[str, RecordedTopic]:
        """The topics of the bag by name."""
        return self.summary.topics

    def raw_messages(self, topics: Collection[str] | None = None, start_ns: int = 0) -> Iterator[RawMessage]:
        """Yield serialised messages of some topics, or of all, from a time of reception in ns since the epoch on.

        File by file, in the order of reception. Messages in damaged chunks are left out; `notes` reports them
        afterwards. Raises `BagError` if the bag has no such topic.
        """
        wanted = set(self.topics()) if topics is None else set(topics)
        missing = sorted(wanted - set(self.topics()))
        if missing:
            known = ", ".join(sorted(self.topics())) or "none"
            raise BagError(f"bag '{self._path}' has no topic '{missing[0]}'; it has {known}")
        types = {name: topic.type for name, topic in self.topics().items()}
        for file in self._files:
            for name, message in file.messages(wanted, start_ns):
                received, sent = message.log_time, message.publish_time
                yield RawMessage(name, types[name], received, sent, message.data, message.sequence)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield messages of some topics, or of all, decoded by the definitions in the bag itself.

        Topics and messages that cannot be decoded are left out; `notes` reports them afterwards. Raises `BagError` if
        the bag has no such topic.
        """
        for raw in self.raw_messages(topics):
            decoded = self.decode(raw)
            if decoded is not None:
                yield BagMessage(raw.topic, raw.log_time_ns, raw.publish_time_ns, decoded)

    def decode(self, raw: RawMessage) -> Any:
        """Decode a message; returns None if that fails, which `notes` reports afterwards."""
        return self._decoder.decode(raw.topic, raw.data, raw.log_time_ns)

    def reception_times(self, topic: str) -> np.ndarray:
        """Return times of reception, (n,) in ns since the epoch, in the order of the file; by the index if possible.

        Raises `BagError` if the bag has no such topic.
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
        """Return the definition of a type from the bag; raises `BagError` if the bag has none."""
        for file in self._files:
            for schema in file.contents.schemas.values():
                if schema.name == type_name:
                    return TypeDefinition(schema.encoding, schema.data, self._type_hash(type_name))
        raise BagError(f"bag '{self._path}' has no definition of the type '{type_name}'")

    def _type_hash(self, type_name: str) -> str:
        """Return the first hash that a channel has of this type, or an empty text."""
        for file in self._files:
            for channel in file.contents.channels.values():
                schema = file.contents.schemas.get(channel.schema_id)
                if schema is not None and schema.name == type_name and channel.metadata.get("topic_type_hash"):
                    return channel.metadata["topic_type_hash"]
        return ""

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
        """Open the files that can be read; one that cannot becomes a note if there are others."""
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
        self._notes += self._damages()
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
        return RecordedTopic(channel.topic, type_name, offered_qos, channel.message_encoding, message_count)

    def _embedded_information(self) -> Mapping[str, Any] | None:
        """Return the copy of the metadata in the last file that has one."""
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

    def _damages(self) -> list[str]:
        return [
            f"{file.path.name}: {file.damaged_chunks} chunks are damaged, their messages are left out"
            for file in self._files
            if file.damaged_chunks
        ]
