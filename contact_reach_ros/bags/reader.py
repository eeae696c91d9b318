"""Reading rosbag2 directories with mcap storage, or single mcap files, without a ROS installation."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.interfaces import QosDurability
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from contact_reach_ros.bags.mcap_file import McapFile, Messages, in_order
from contact_reach_ros.bags.message_types import decode
from contact_reach_ros.bags.topics import CDR, MCAP_KEY, MCAP_NAME, RecordedTopic
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.topics import ALL
from contact_reach_ros.timing import NANOSECONDS

_TYPES = {f"/{topic.name}": topic.type_name for topic in ALL}
_STATES, _SAFETY = "/joint_states", "/safety_state"
"""Topics that every stack has."""


class RawMessage(NamedTuple):
    """A serialised message, with times of reception and sending in ns since the epoch and its publisher's number."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes
    sequence: int


class BagReader:
    """A recorded bag: a directory as rosbag2 makes it, or one mcap file.

    Raises `BagError` if it is missing, empty or not stored as mcap; with `of_stack` also if it has several stacks.

    Parameters
    ----------
    path :
        The bag.
    of_stack :
        Whether topics go without the namespace of the stack that was recorded, and those of its names that are not of
        its types get other ones.

    Attributes
    ----------
    topics :
        Topics by name.
    start_ns :
        Reception of the first message, ns since the epoch; 0 without messages.
    duration :
        From the first to the last message, s.
    custom_data :
        Text stored with the recording.
    """

    def __init__(self, path: Path | str, of_stack: bool = False) -> None:
        self.path = Path(path)
        self._notes: list[str] = []
        try:
            os.stat(self.path)
            paths = self._find_files() if self.path.is_dir() else [self.path]
        except PermissionError as error:
            raise BagError(f"bag '{self.path}' cannot be read: {error.strerror}") from error
        except OSError as error:
            raise BagError(f"bag '{self.path}' does not exist") from error
        if not paths:
            raise BagError(f"'{self.path}' is no bag with mcap files; `ros2 bag convert` can convert other recordings")
        self._files = self._open(paths)
        if of_stack:
            self._leave_namespace()
            self._set_aside_foreign()
        self.topics = self._read_topics()
        spans = [file.span_ns for file in self._files if file.span_ns is not None]
        self.start_ns = min((start for start, _ in spans), default=0)
        self.duration = (max((end for _, end in spans), default=0) - self.start_ns) / NANOSECONDS
        self.custom_data = self._read_custom_data()
        self._undecoded: Counter[str] = Counter()

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    @property
    def notes(self) -> tuple[str, ...]:
        """Defects found so far that do not prevent reading, one sentence each; reading messages may add some."""
        undecoded = (
            f"topic '{topic}': {count} messages are left out, no {self.topics[topic].type} of ROS 2 Jazzy in CDR"
            for topic, count in self._undecoded.items()
        )
        return (*self._notes, *chain.from_iterable(file.notes() for file in self._files), *undecoded)

    def batches(self, topics: Sequence[str], start_ns: int = 0) -> Iterator[Messages]:
        """Yield messages of topics in the order of reception, many at once, from a time in ns since the epoch on.

        Their topics are numbers, places in `topics`. Messages in damaged chunks are left out; `notes` reports them
        afterwards. Raises `BagError` if the bag has no such topic.
        """
        missing = sorted(set(topics) - self.topics.keys())
        if missing:
            known = ", ".join(sorted(self.topics)) or "none"
            raise BagError(f"bag '{self.path}' has no topic '{missing[0]}'; it has {known}")
        return in_order(self._files, topics, start_ns)

    def pass_on(self, handlers: Mapping[str, Callable[[Messages], None]]) -> None:
        """Pass the messages of some topics to their handlers, many at once; skip topics that the bag lacks."""
        names = [name for name in handlers if name in self.topics]
        for batch in self.batches(names):
            for number, name in enumerate(names):
                messages = batch[batch["topic"] == number]
                if len(messages):
                    handlers[name](messages)

    def raw_messages(self, topics: Collection[str] | None = None, start_ns: int = 0) -> Iterator[RawMessage]:
        """Yield serialised messages of some topics, or of all, one by one; as `batches`."""
        names = sorted(self.topics if topics is None else topics)
        for batch in self.batches(names, start_ns):
            for number, *message in batch.tolist():
                yield RawMessage(names[number], *message)

    def messages(self, topic: str) -> Iterator[Any]:
        """The messages of a topic, which the bag may lack; those that `decode` cannot decode are left out."""
        decoded = map(self.decode, self.raw_messages({topic} & self.topics.keys()))
        return (message for message in decoded if message is not None)

    def decode(self, raw: RawMessage) -> Any:
        """Decode a message of one of ROS 2 Jazzy's types: fields by attribute, number sequences as arrays.

        Returns None if it is none, or not serialised as CDR, which `notes` reports afterwards.
        """
        topic = self.topics[raw.topic]
        message = decode(topic.type, raw.data) if topic.encoding == CDR else None
        if message is None:
            self._undecoded[raw.topic] += 1
        return message

    def _find_files(self) -> list[Path]:
        """Files of a bag's directory."""
        names = sorted(os.listdir(self.path))
        found = [name for name in names if name.endswith(".mcap")]
        # Compressed as a whole, as of a recorder that was killed.
        found += [name for name in names if name.endswith(".mcap.zstd") and name.removesuffix(".zstd") not in found]
        return [self.path / name for name in sorted(found)]

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
        """Take the namespace of the joint states off all topics; raises `BagError` if there are several stacks.

        What has the name of one of them without a namespace is of others, such as a second arm, and is named so.
        """
        channels = [file.channels for file in self._files]
        names = {channel.topic for channel in chain.from_iterable(known.values() for known in channels)}
        found = (name.removesuffix(_STATES) for name in names if name.endswith(_STATES))
        spaces = sorted(space for space in found if space + _SAFETY in names)
        if len(spaces) > 1:
            raise BagError(
                f"bag '{self.path}' has several stacks: {', '.join(space or '/' for space in spaces)}; expected one: "
                "record each with its own bring-up"
            )
        if not (spaces and spaces[0]):
            return
        named = {name: name.removeprefix(spaces[0]) for name in names if name.startswith(f"{spaces[0]}/")}
        named |= {name: f"{name} (outside {spaces[0]})" for name in named.values() if name in names}
        for known in channels:
            for number, channel in known.items():
                known[number] = dataclasses.replace(channel, topic=named.get(channel.topic, channel.topic))

    def _set_aside_foreign(self) -> None:
        """Add its type to the name of each topic that has a stack's name, but not the type."""
        for file in self._files:
            for number, channel in file.channels.items():
                name, schema = channel.topic, file.schemas.get(channel.schema_id)
                kind, expected = schema.name if schema else "no type", _TYPES.get(name)
                if expected not in (None, kind):
                    note = f"topic '{name}': is {kind}, expected {expected}; it is left out"
                    self._notes += [note] * (note not in self._notes)
                    file.channels[number] = dataclasses.replace(channel, topic=f"{name} ({kind})")

    def _read_topics(self) -> Mapping[str, RecordedTopic]:
        topics: dict[str, RecordedTopic] = {}
        for file in self._files:
            for number, channel in file.channels.items():
                name, schema = channel.topic, file.schemas.get(channel.schema_id)
                kind = schema.name if schema else ""
                latched = _is_latched(channel.metadata.get("offered_qos_profiles", ""))
                known = topics.get(name, RecordedTopic(name, kind, latched=latched, encoding=channel.message_encoding))
                if known.type != kind:
                    raise BagError(f"{file.path}: topic '{name}' has both type {known.type} and {kind}, expected one")
                count = known.message_count + file.message_counts[number]
                topics[name] = dataclasses.replace(known, message_count=count)
        return topics

    def _read_custom_data(self) -> dict[str, str]:
        """Return what rosbag2's metadata holds, of which each file has a copy, from the last that has one."""
        for file in reversed(self._files):
            try:
                content = yaml.safe_load(file.metadata.get(MCAP_NAME, {}).get(MCAP_KEY, ""))
            except yaml.YAMLError as error:
                self._notes.append(f"the metadata inside {file.path.name} cannot be read: {error}")
                continue
            if isinstance(content, dict):
                kept = content.get("custom_data")
                return {str(key): str(value) for key, value in kept.items()} if isinstance(kept, dict) else {}
        return {}


def _is_latched(profiles: str) -> bool:
    """Whether a publisher was latched, by the profiles that an mcap channel holds as YAML; False if unreadable."""
    try:
        return any(qos.durability is QosDurability.TRANSIENT_LOCAL for qos in parse_qos(profiles))
    except (ReaderError, KeyError, TypeError, AttributeError):
        return False
