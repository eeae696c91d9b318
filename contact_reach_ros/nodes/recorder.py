"""Recorder: writes the topics of the robot into a bag until it is told to stop."""

from __future__ import annotations

import datetime
import shutil
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.errors import BagError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.topic_recorder import TopicRecorder
from contact_reach_ros.recording.bag_writer import COMPRESSIONS, BagWriter
from contact_reach_ros.recording.topics import parse_topic
from contact_reach_ros.settings import Settings, setting
from contact_reach_ros.units import NANOSECONDS
from contact_reach_ros.versions import git_revision, versions

_MEGA = 1e6
DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.1
FLUSH_PERIOD = 0.5
"""A recorder that is killed loses what came within this time, s; a power cut also what the disk was about to write."""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """What to record, and where to."""

    bag: str = setting("", "directory to create; named after date and time when empty, never overwritten")
    topics: tuple[str, ...] = setting((), "name or name:package/msg/Type each; everything of the stack when empty")
    custom_data: tuple[str, ...] = setting((), "key=value each: text to keep in the bag, such as scene and seed")
    files: tuple[str, ...] = setting((), "key=path each: text files to keep in the bag, such as the parameter file")


@dataclass(frozen=True)
class StorageSettings(Settings):
    """How to store it."""

    compression: str = setting(
        "zstd", "compression of the file's chunks: half the size for a tenth more work", choices=tuple(COMPRESSIONS)
    )
    split_mb: float = setting(0.0, "size at which another file is begun; 0: never", unit="MB", minimum=0.0)
    split_s: float = setting(0.0, "time after which another file is begun; 0: never", unit="s", minimum=0.0)
    min_free_mb: float = setting(
        500.0, "space that is left to others: with less the bag is completed, or not begun", unit="MB", minimum=0.0
    )


class RecorderNode(ManagedNode):
    """Records from its activation to its deactivation."""

    NAME = "recorder"
    SECTIONS: ClassVar[Sections] = {"": RecorderSettings, "storage": StorageSettings}

    def __init__(self) -> None:
        super().__init__()
        self._writer: BagWriter | None = None
        self._recorder: TopicRecorder | None = None
        self._next_discovery = self._next_flush = 0.0
        self._ended_early = ""
        self._lock = threading.Lock()
        """Between the loop thread and a deactivation."""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the bag."""
        settings: RecorderSettings = self.settings[""]
        storage: StorageSettings = self.settings["storage"]
        directory = Path(settings.bag or f"contact_reach_{datetime.datetime.now():%Y_%m_%d-%H_%M_%S}")
        self._ended_early = ""
        try:
            wanted = [parse_topic(text) for text in settings.topics or [topic.name for topic in topics.ALL]]
            custom_data = {**_provenance(), **_custom_data(settings)}
            shortage = _shortage(directory, storage)
            if shortage:
                raise BagError(f"bag '{directory}' is not begun: {shortage}")
            self._writer = BagWriter(
                directory,
                compression=storage.compression,
                custom_data=custom_data,
                split_bytes=int(storage.split_mb * _MEGA),
                split_ns=int(storage.split_s * NANOSECONDS),
            )
        except BagError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        self._recorder = TopicRecorder(self, self._writer, wanted)
        self._next_discovery = self._next_flush = time.monotonic()
        self.get_logger().info(f"recording to {directory}")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Complete the bag."""
        result = super().on_deactivate(state)
        self.close()
        return result

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Messages written and lost."""
        if self._ended_early:
            return f"not recording: {self._ended_early}", {}
        if self._writer is None or self._recorder is None:
            return "", {}
        lost = self._recorder.lost
        return f"{lost} messages lost" if lost else "", {"messages": self._writer.message_count, "messages lost": lost}

    def turn(self) -> None:
        """Write what has arrived; now and then look for new topics and hand the data to the disk.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        self._stop.wait(DRAIN_PERIOD)
        with self._lock:
            if self._writer is not None and self._recorder is not None:
                self._record(self._writer, self._recorder)

    def _record(self, writer: BagWriter, recorder: TopicRecorder) -> None:
        now = time.monotonic()
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD
            recorder.discover()
        recorder.drain()
        if now >= self._next_flush:
            self._next_flush = now + FLUSH_PERIOD
            recorder.note_losses()
            writer.flush(durable=True)
            self._ended_early = _shortage(writer.directory, self.settings["storage"])
            if self._ended_early:
                # Others need the disk as well, and an arm need not stop because nobody writes down what it does.
                self.say(LoggingSeverity.ERROR, f"the recording ends here: {self._ended_early}")
                self._complete()

    def close(self) -> None:
        """Write what is still on its way and complete the bag.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        with self._lock:
            self._complete()
        self.write_out()

    def _complete(self) -> None:
        if self._writer is None or self._recorder is None:
            return
        writer, recorder = self._writer, self._recorder
        self._writer = self._recorder = None
        with writer:
            recorder.stop()
        size = sum(file.stat().st_size for file in writer.directory.iterdir()) / _MEGA
        line = f"recorded {writer.message_count} messages ({recorder.lost} lost), {size:.1f} MB, in {writer.directory}"
        self.say(LoggingSeverity.INFO, line)


def main() -> None:
    """Run the recorder."""
    sys.exit(run(RecorderNode, Role.BACKGROUND, sys.argv))


def _custom_data(settings: RecorderSettings) -> dict[str, str]:
    """The text that the parameters name.

    Raises
    ------
    BagError
        If an entry is no key=value, or a file cannot be read.
    """
    custom_data = dict(_key_and_value("custom_data", text) for text in settings.custom_data)
    for key, path in (_key_and_value("files", text) for text in settings.files):
        try:
            custom_data[key] = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise BagError(f"parameter files, entry '{key}': {path} cannot be read as text: {error}") from error
    return custom_data


def _provenance() -> dict[str, str]:
    revision = git_revision()
    made_by = {"versions": yaml.safe_dump({**versions(), "rmw": get_rmw_implementation_identifier()})}
    return made_by if revision is None else {**made_by, "git_revision": revision}


def _shortage(directory: Path, storage: StorageSettings) -> str:
    """Says what is missing if the disk has less space than is to be left; else empty."""
    existing = directory.resolve()
    while not existing.is_dir():
        existing = existing.parent
    free = shutil.disk_usage(existing).free / _MEGA
    if free >= storage.min_free_mb:
        return ""
    return (
        f"{free:.0f} MB are free in {existing}, fewer than the {storage.min_free_mb:.0f} MB of storage.min_free_mb; "
        "make room, or record elsewhere"
    )


def _key_and_value(parameter: str, text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter {parameter}, entry '{text}': expected key=value")
    return key, value


if __name__ == "__main__":
    main()
