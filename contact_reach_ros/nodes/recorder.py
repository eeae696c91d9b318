"""Recorder: writes the topics of the robot into a bag until it is told to stop."""

from __future__ import annotations

import datetime
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from contact_reach_ros.errors import BagError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.managed import ManagedNode, run
from contact_reach_ros.nodes.parameters import Sections
from contact_reach_ros.nodes.realtime import Role
from contact_reach_ros.nodes.topic_recorder import TopicRecorder
from contact_reach_ros.recording.bag_writer import COMPRESSIONS, BagWriter
from contact_reach_ros.recording.topics import parse_topic
from contact_reach_ros.settings import Settings, setting

RECORDED = (
    topics.JOINT_STATES,
    topics.COMMANDS,
    topics.GOAL_POSE,
    topics.REFERENCE_POSE,
    topics.REFERENCE_POSTURE,
    topics.OBSTACLES,
    topics.EXTERNAL_TORQUE,
    topics.EXTERNAL_WRENCH,
    topics.SAFETY_STATE,
    topics.DIAGNOSTICS,
    topics.PLAN_PATH,
    topics.PLAN_MARKERS,
    topics.SIM_CONTACTS,
    topics.ROBOT_DESCRIPTION,
    topics.CLOCK,
)
"""What is recorded when no topic is named."""

DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.1
FLUSH_PERIOD = 1.0
"""A recorder that is killed loses what came within this time, s."""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """What to record, and where to."""

    bag: str = setting("", "directory to create; named after date and time when empty, never overwritten")
    topics: tuple[str, ...] = setting((), "name or name:package/msg/Type each; everything of the stack when empty")
    custom_data: tuple[str, ...] = setting((), "key=value each: text to keep in the bag, such as scene and seed")


@dataclass(frozen=True)
class StorageSettings(Settings):
    """How to store it."""

    compression: str = setting(
        "zstd", "compression of the file's chunks: half the size for a tenth more work", choices=tuple(COMPRESSIONS)
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
        self._lock = threading.Lock()
        """Between the loop thread and a deactivation."""

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the bag."""
        settings: RecorderSettings = self.settings[""]
        directory = settings.bag or f"contact_reach_{datetime.datetime.now():%Y_%m_%d-%H_%M_%S}"
        try:
            wanted = [parse_topic(text) for text in settings.topics or [topic.name for topic in RECORDED]]
            custom_data = dict(map(_key_and_value, settings.custom_data))
            compression = self.settings["storage"].compression
            self._writer = BagWriter(Path(directory), compression=compression, custom_data=custom_data)
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
            writer.flush()

    def close(self) -> None:
        """Write what is still on its way and complete the bag.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        with self._lock:
            if self._writer is None or self._recorder is None:
                return
            writer, recorder = self._writer, self._recorder
            self._writer = self._recorder = None
            with writer:
                recorder.stop()
        size = sum(file.stat().st_size for file in writer.directory.iterdir()) / 1e6
        self.get_logger().info(
            f"recorded {writer.message_count} messages ({recorder.lost} lost), {size:.1f} MB, in {writer.directory}"
        )


def main() -> None:
    """Run the recorder."""
    sys.exit(run(RecorderNode, Role.BACKGROUND, sys.argv))


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter custom_data, entry '{text}': expected key=value")
    return key, value


if __name__ == "__main__":
    main()
