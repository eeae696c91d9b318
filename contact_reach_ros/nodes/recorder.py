"""The recorder: writes the robot's topics to a bag until it is stopped."""

from __future__ import annotations

import datetime
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from rclpy.exceptions import InvalidTopicNameException
from rclpy.utilities import get_rmw_implementation_identifier
from rclpy.validate_topic_name import validate_topic_name

from contact_reach_ros.bags.settings import MEGA, RECORDER_SECTIONS, RecorderSettings, shortage_in
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.topic_recorder import TopicRecorder
from contact_reach_ros.resources import git_revision, versions
from contact_reach_ros.ros.lockstep import FOREVER_NS
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import NANOSECONDS

DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.1
AHEAD_NS = NANOSECONDS // 2
"""Simulated time that the recorder may lag behind: its queues hold 4000 messages, and a tick has up to three each."""
FLUSH_PERIOD = 0.5
"""A recorder that is killed loses the messages of this time, s; a power cut also what the disk was about to write."""


class RecorderNode(ManagedNode):
    """Records from its activation to its deactivation."""

    NAME = "recorder"
    SECTIONS = RECORDER_SECTIONS

    def __init__(self) -> None:
        super().__init__()
        self._lockstep = self.make_lockstep()
        self._recorder: TopicRecorder | None = None
        self._next_discovery = self._next_flush = 0.0
        self._ended_early = ""
        self._lock = threading.Lock()
        """Lock between the loop thread and a deactivation."""

    def activate(self) -> None:
        """Create the bag."""
        settings: RecorderSettings = self.settings[""]
        directory = Path(settings.bag or f"contact_reach_{datetime.datetime.now():%Y_%m_%d-%H_%M_%S}")
        self._ended_early = ""
        wanted = [self._resolved(name) for name in settings.topics or [topic.name for topic in topics.ALL]]
        custom_data = _provenance() | settings.texts()
        shortage = shortage_in(directory)
        if shortage:
            raise BagError(f"bag '{directory}' is not begun: {shortage}")
        writer = BagWriter(directory, custom_data=custom_data)
        self._recorder = TopicRecorder(self, writer, wanted)
        self._next_discovery = self._next_flush = time.monotonic()
        self.get_logger().info(f"recording to {directory}")

    def deactivate(self) -> None:
        """Complete the bag."""
        self.close()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Messages written and lost."""
        if self._ended_early:
            return f"not recording: {self._ended_early}", {}
        if self._recorder is None:
            return "", {}
        lost, written = self._recorder.lost, self._recorder.writer.message_count
        return f"{lost} messages lost" if lost else "", {"messages": written, "messages lost": lost}

    def turn(self) -> None:
        """Write what has arrived; now and then look for new topics and flush the data to the disk.

        Raises `BagError` if writing fails.
        """
        self._stop.wait(DRAIN_PERIOD)
        with self._lock:
            if self._recorder is not None:
                self._record(self._recorder)

    def _resolved(self, name: str) -> str:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            raise BagError(f"parameter topics: '{name}' is no topic name; expected one, without a type") from error
        return self.resolve_topic_name(name)

    def _record(self, recorder: TopicRecorder) -> None:
        now = time.monotonic()
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD
            recorder.discover()
        recorder.drain()
        if recorder.stamp_ns is not None:
            # Each time: the driver may not have heard the first ones.
            self._lockstep.promise(min(recorder.stamp_ns + AHEAD_NS, FOREVER_NS))
        if now >= self._next_flush:
            self._next_flush = now + FLUSH_PERIOD
            recorder.flush()
            self._ended_early = shortage_in(recorder.writer.directory)
            if self._ended_early:
                # Others need the disk as well, and the end of a recording is not a reason to stop the arm.
                self.get_logger().error(f"the recording ends here: {self._ended_early}")
                self._complete()

    def close(self) -> None:
        """Write what is still in transit and complete the bag; raises `BagError` if writing fails."""
        with self._lock:
            self._complete()

    def _complete(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return
        self._lockstep.promise(FOREVER_NS)
        recorder.stop()
        written, directory = recorder.writer.message_count, recorder.writer.directory
        size = sum(file.stat().st_size for file in directory.iterdir()) / MEGA
        line = f"recorded {written} messages ({recorder.lost} lost), {size:.1f} MB, in {directory}"
        self.get_logger().info(line)


def _provenance() -> dict[str, str]:
    """Return the versions that record, as custom data."""
    made_by = {"versions": yaml.safe_dump({**versions(), "rmw": get_rmw_implementation_identifier()})}
    revision = git_revision()
    return made_by if revision is None else {**made_by, "git_revision": revision}


if __name__ == "__main__":
    sys.exit(run(RecorderNode, sys.argv))
