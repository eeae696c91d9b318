"""Recorder: writes the topics of the robot into a bag until it is told to stop."""

from __future__ import annotations

import datetime
import signal
import sys
import threading
import time
from collections.abc import Sequence

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from contact_reach_ros.errors import BagError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.topic_recorder import TopicRecorder
from contact_reach_ros.recording.bag_writer import COMPRESSIONS, BagWriter
from contact_reach_ros.recording.topics import parse_topic

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
    topics.SIM_CONTACTS,
    topics.ROBOT_DESCRIPTION,
    topics.CLOCK,
)
"""What is recorded when no topic is named."""

DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.1
FLUSH_PERIOD = 1.0
"""A recorder that is killed loses what came within this time, s."""


class RecorderNode(Node):
    """The recorder as a node.

    Raises
    ------
    BagError
        If the bag cannot be made or a parameter is not accepted.
    """

    def __init__(self) -> None:
        super().__init__("recorder")
        started = datetime.datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
        directory = self._text("bag", f"contact_reach_{started}", "Directory to create for the bag.")
        listed = self._texts("topics", "Topics, as name or name:package/msg/Type; all of the stack if empty.")
        choices = ", ".join(COMPRESSIONS)
        compression = self._text("storage.compression", "zstd", f"Compression of the file: one of {choices}.")
        entries = self._texts("custom_data", "Text to keep in the bag, as key=value.")
        wanted = [parse_topic(text) for text in listed or [topic.name for topic in RECORDED]]
        custom_data = dict(map(_key_and_value, entries))
        self._writer = BagWriter(directory, compression=compression, custom_data=custom_data)
        self._recorder = TopicRecorder(self, self._writer, wanted)
        self._next_discovery = self._next_flush = time.monotonic()
        self.get_logger().info(f"recording to {directory}")

    def turn(self) -> None:
        """Write what has arrived; now and then look for new topics and hand the data to the disk.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        now = time.monotonic()
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD
            self._recorder.discover()
        self._recorder.drain()
        if now >= self._next_flush:
            self._next_flush = now + FLUSH_PERIOD
            self._writer.flush()

    def finish(self) -> None:
        """Write what is still on its way and complete the bag.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        with self._writer:
            self._recorder.stop()
        size = sum(file.stat().st_size for file in self._writer.directory.iterdir()) / 1e6
        self.get_logger().info(
            f"recorded {self._writer.message_count} messages ({self._recorder.lost} lost), {size:.1f} MB,"
            f" in {self._writer.directory}"
        )

    def _text(self, name: str, default: str, description: str) -> str:
        descriptor = ParameterDescriptor(description=description, read_only=True)
        return str(self.declare_parameter(name, default, descriptor).value)

    def _texts(self, name: str, description: str) -> list[str]:
        descriptor = ParameterDescriptor(description=description, read_only=True)
        value = self.declare_parameter(name, Parameter.Type.STRING_ARRAY, descriptor).value
        return [text for text in value or [] if text]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder until SIGINT or SIGTERM; 0 if the bag is complete, 1 otherwise."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = RecorderNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # Serves parameters and the like; the messages are drained by this thread.
        spinning = threading.Thread(target=executor.spin, name="spin", daemon=True)
        spinning.start()
        try:
            while not stop.wait(DRAIN_PERIOD):
                node.turn()
        finally:
            try:
                node.finish()
            finally:
                executor.shutdown()
                spinning.join()
                node.destroy_node()
    except (BagError, InvalidParameterTypeException) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter custom_data, entry '{text}': expected key=value")
    return key, value


if __name__ == "__main__":
    sys.exit(main())
