"""Reading rosbag2 directories with mcap storage, or single mcap files, without a ROS installation."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from mcap.records import Channel, Schema

from contact_reach_ros.bags import metadata as bag_metadata
from contact_reach_ros.bags.mcap_file import McapFile
from contact_reach_ros.bags.message_types import Decoder
from contact_reach_ros.bags.topics import RecordedTopic, TypeDefinition, read_offered_qos
from contact_reach_ros.errors import BagError
from contact_reach_ros.timing import NANOSECONDS

_STATES, _SAFETY = "/joint_states", "/safety_state"
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

    Raises `BagError` if it is missing, empty or not stored as mcap; with `of_stack` also if it has several stacks.

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
        information = self._read_information() if self._path.is_dir() else {}
        self._files = self._open(self._find_files(information))
        if of_stack:
            self._leave_namespace()
        self.summary = self._summarise(information or self._embedded_information())
        self._decoder = Decoder(self.summary.topics, self.definition)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the summary, with damaged chunks and undecodable messages found since."""
        return (*self._notes, *chain.from_iterable(file.notes() for file in self._files), *self._decoder.notes())

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
        return self._decoder.decode(raw.topic, raw.data)

    def reception_times(self, topic: str) -> np.ndarray:
        """Return times of reception, (n,) in ns since the epoch; raises `BagError` if the bag has no such topic."""
        return np.array([raw.log_time_ns for raw in self.raw_messages([topic])], np.int64)

    def definition(self, type_name: str) -> TypeDefinition:
        """Return the definition of a type from the bag; raises `BagError` if the bag has none."""
        schemas = [schema for file in self._files for schema in file.schemas.values() if schema.name == type_name]
        if not schemas:
            raise BagError(f"bag '{self._path}' has no definition of the type '{type_name}'")
        hashes = (
            channel.metadata.get("topic_type_hash", "")
            for file in self._files
            for channel in file.channels.values()
            if channel.schema_id in file.schemas and file.schemas[channel.schema_id].name == type_name
        )
        return TypeDefinition(schemas[0].encoding, schemas[0].data, next(filter(None, hashes), ""))

    def _read_information(self) -> Mapping[str, Any]:
        """Read metadata.yaml; a missing or damaged one becomes a note."""
        try:
            return bag_metadata.read(self._path)
        except BagError as error:
            self._notes.append(str(error))
            return {}

    def _find_files(self, information: Mapping[str, Any]) -> Sequence[Path]:
        if not self._path.is_dir():
            return [self._path]
        if str(information.get("compression_mode")).lower() == "message":
            raise BagError(f"the messages of bag '{self._path}' are compressed; `ros2 bag convert` can convert it")
        named = information.get("relative_file_paths")
        if isinstance(named, list) and named:
            return [self._path / Path(str(name)).name for name in named]
        files = sorted(self._path.glob("*.mcap"), key=_file_number)
        if not files:
            raise BagError(f"'{self._path}' is no bag with mcap files; `ros2 bag convert` can convert other recordings")
        return files

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

    def _leave_namespace(self) -> None:
        """Take the namespace of the joint states off all topics; raises `BagError` if there are several stacks."""
        channels = [file.channels for file in self._files]
        names = {channel.topic for channel in chain.from_iterable(known.values() for known in channels)}
        found = (name.removesuffix(_STATES) for name in names if name.endswith(_STATES))
        spaces = sorted(space for space in found if space + _SAFETY in names)
        if len(spaces) > 1:
            raise BagError(
                f"bag '{self._path}' has several stacks: {', '.join(space or '/' for space in spaces)}; expected one: "
                "record each with its own bring-up"
            )
        for known in channels if spaces and spaces[0] else ():
            for number, channel in known.items():
                if channel.topic.startswith(f"{spaces[0]}/"):
                    known[number] = dataclasses.replace(channel, topic=channel.topic.removeprefix(spaces[0]))

    def _summarise(self, information: Mapping[str, Any]) -> BagSummary:
        topics: dict[str, RecordedTopic] = {}
        for file in self._files:
            for number, channel in file.channels.items():
                found = self._topic(channel, file.schemas.get(channel.schema_id))
                known = topics.setdefault(channel.topic, found)
                if known.type != found.type:
                    raise BagError(
                        f"{file.path}: topic '{channel.topic}' has both type {known.type} and {found.type},"
                        " expected one"
                    )
                count = known.message_count + file.message_counts[number]
                topics[channel.topic] = dataclasses.replace(known, message_count=count)
        spans = [file.span_ns for file in self._files if file.span_ns is not None]
        start_ns, end_ns = min((start for start, _ in spans), default=0), max((end for _, end in spans), default=0)
        notes = (*self._notes, *chain.from_iterable(file.notes() for file in self._files))
        kept = information.get("custom_data")
        texts = {str(key): str(value) for key, value in kept.items()} if isinstance(kept, dict) else {}
        return BagSummary(self._path, topics, start_ns, (end_ns - start_ns) / NANOSECONDS, texts, notes)

    def _topic(self, channel: Channel, schema: Schema | None) -> RecordedTopic:
        try:
            offered_qos = read_offered_qos(channel.metadata.get("offered_qos_profiles", ""))
        except BagError as error:
            self._notes.append(f"topic '{channel.topic}': {error}")
            offered_qos = ()
        return RecordedTopic(channel.topic, schema.name if schema else "", offered_qos, channel.message_encoding)

    def _embedded_information(self) -> Mapping[str, Any]:
        """Return the copy of the metadata in the last file that has one; empty if there is none."""
        for file in reversed(self._files):
            text = file.metadata.get(bag_metadata.MCAP_NAME, {}).get(bag_metadata.MCAP_KEY, "")
            try:
                content = yaml.safe_load(text)
            except yaml.YAMLError as error:
                self._notes.append(f"the metadata inside {file.path.name} cannot be read: {error}")
                continue
            if isinstance(content, dict):
                return content
        return {}


def _file_number(path: Path) -> tuple[int, str]:
    """Sort key for the files of a split bag: the number at the end of the name, then the name."""
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdigit() else 0, path.name)
