"""Recorder: writes the topics of the robot into a bag, without decoding them."""

from __future__ import annotations

import dataclasses
import datetime
import importlib
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording.bag_writer import BagWriter
from contact_reach_ros.recording.loss import LossCounter
from contact_reach_ros.recording.topics import STANDARD_TOPICS, OfferedQos, Topic, parse_topic

HISTORY_DEPTH = 1000
"""Messages per topic that wait in the middleware while the recorder is held up: 1 s at 1 kHz."""

DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.5
FLUSH_PERIOD = 1.0
SETTLING_TIME = 0.05
"""Time for messages that are on their way when the recording ends, s."""


class _Drained(CallbackGroup):
    """Keeps subscriptions away from the executor.

    Waking up for every message costs ten times more than taking what has gathered every few milliseconds.
    """

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing was begun."""


@dataclasses.dataclass
class _Recorded:
    topic: Topic
    message_class: type
    qos: QoSProfile
    subscription: Subscription
    loss: LossCounter


class TopicRecorder:
    """Moves the messages of topics into a bag.

    Parameters
    ----------
    node :
        Owner of the subscriptions.
    writer :
        The bag; it stays with the caller, who closes it after `stop`.
    topics :
        Names as `parse_topic` reads them; relative ones are resolved by the node.
    """

    def __init__(self, node: Node, writer: BagWriter, topics: Iterable[str]) -> None:
        self._node = node
        self._writer = writer
        self._group = _Drained()
        self._recorded: dict[str, _Recorded] = {}
        self._refused: set[str] = set()
        self._wanted: dict[str, str | None] = {}
        for name, type_name in map(parse_topic, topics):
            self._wanted[node.resolve_topic_name(name)] = type_name

    def discover(self) -> None:
        """Subscribe to the wanted topics that have appeared since the last call."""
        for name in self._wanted:
            if name in self._refused or not self._node.count_publishers(name):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            recorded = self._recorded.get(name)
            if recorded is None:
                try:
                    self._begin(name, publishers)
                except BagError as error:
                    self._refused.add(name)
                    self._node.get_logger().error(f"not recorded: {error}")
            elif _asks_too_much(recorded.qos, publishers):
                # A publisher that offers less has joined: with the old terms nothing would come from it.
                self.drain()
                self._node.destroy_subscription(recorded.subscription)
                recorded.qos = _acceptable_qos(publishers)
                recorded.subscription = self._subscribe(name, recorded.message_class, recorded.qos)

    def drain(self) -> None:
        """Write what has arrived, in the order of arrival.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        batch: list[tuple[int, _Recorded, bytes, Any]] = []
        for recorded in self._recorded.values():
            handle = recorded.subscription.handle
            with handle:
                for _ in range(HISTORY_DEPTH):
                    taken = handle.take_message(recorded.message_class, True)
                    if taken is None:
                        break
                    data, about = taken
                    batch.append((about["received_timestamp"] or time.time_ns(), recorded, data, about))
        batch.sort(key=itemgetter(0))
        for received_ns, recorded, data, about in batch:
            sequence = about["publication_sequence_number"]
            recorded.loss.count(sequence, recorded.subscription.get_publisher_count)
            sent_ns = about["source_timestamp"] or received_ns
            self._writer.write(recorded.topic.name, data, received_ns, sent_ns, sequence or 0)

    def stop(self) -> None:
        """Write what is still on its way, and note in the bag how many messages were lost.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        self.drain()
        time.sleep(SETTLING_TIME)
        self.drain()
        known = all(recorded.loss.known for recorded in self._recorded.values())
        self._writer.set_custom_data("messages_lost", str(self.lost) if known else "unknown")
        for name, recorded in self._recorded.items():
            if recorded.loss.lost:
                self._writer.set_custom_data(f"messages_lost{name}", str(recorded.loss.lost))
            self._node.destroy_subscription(recorded.subscription)
        self._recorded.clear()

    @property
    def lost(self) -> int:
        """Messages that were sent while their topic was recorded and did not arrive."""
        return sum(recorded.loss.lost for recorded in self._recorded.values())

    def _begin(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        types = sorted({publisher.topic_type for publisher in publishers})
        expected = self._wanted[name] or types[0]
        if types != [expected]:
            raise BagError(f"topic '{name}' has the type {', '.join(types)}, expected {expected}")
        message_class = _message_class(expected)
        qos = _acceptable_qos(publishers)
        offered = tuple(_offered(publisher.qos_profile) for publisher in publishers)
        topic = Topic(name, expected, offered)
        self._writer.add_topic(topic)
        subscription = self._subscribe(name, message_class, qos)
        self._recorded[name] = _Recorded(topic, message_class, qos, subscription, LossCounter())

    def _subscribe(self, name: str, message_class: type, qos: QoSProfile) -> Subscription:
        return self._node.create_subscription(
            message_class, name, lambda _: None, qos, callback_group=self._group, raw=True
        )


class RecorderNode(Node):
    """The recorder as a node; `record` does the work until it is told to stop."""

    def __init__(self) -> None:
        super().__init__("recorder")
        started = datetime.datetime.now().strftime("%Y_%m_%d-%H_%M_%S")
        directory = Path(self.declare_parameter("bag", f"contact_reach_{started}").value)
        topics = [text for text in self._texts("topics") if text]
        compression = self.declare_parameter("storage.compression", "zstd").value
        custom_data = dict(_key_and_value(text) for text in self._texts("custom_data") if text)
        self.writer = BagWriter(directory, compression=compression, custom_data=custom_data)
        self._recorder = TopicRecorder(self, self.writer, topics or STANDARD_TOPICS)
        self.get_logger().info(f"recording to {directory}")

    def record(self, stop: threading.Event) -> None:
        """Record until `stop` is set, then complete the bag.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        next_discovery = next_flush = time.monotonic()
        with self.writer:
            while not stop.is_set():
                now = time.monotonic()
                if now >= next_discovery:
                    next_discovery = now + DISCOVERY_PERIOD
                    self._recorder.discover()
                self._recorder.drain()
                if now >= next_flush:
                    next_flush = now + FLUSH_PERIOD
                    self.writer.flush()
                stop.wait(DRAIN_PERIOD)
            lost = self._recorder.lost
            self._recorder.stop()
        size = sum(file.stat().st_size for file in self.writer.directory.iterdir())
        self.get_logger().info(
            f"recorded {self.writer.message_count} messages ({lost} lost), {size / 1e6:.1f} MB,"
            f" in {self.writer.directory}"
        )

    def _texts(self, name: str) -> list[str]:
        return list(self.declare_parameter(name, Parameter.Type.STRING_ARRAY).value or [])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the recorder until SIGINT or SIGTERM; 0 if the bag is complete, 1 otherwise."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    rclpy.init(
        args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO
    )
    try:
        node = RecorderNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        # Serves parameters and the like; the messages are drained by this thread.
        spinning = threading.Thread(target=executor.spin, name="spin", daemon=True)
        spinning.start()
        try:
            node.record(stop)
        finally:
            executor.shutdown()
            spinning.join()
            node.destroy_node()
    except BagError as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _message_class(type_name: str) -> type:
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise BagError(
            f"message type '{type_name}' is not installed; source the workspace that has it"
        ) from error


def _acceptable_qos(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """The strictest terms that every publisher meets, with a deep queue."""
    offered = [publisher.qos_profile for publisher in publishers]
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
    latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)
    return QoSProfile(
        depth=HISTORY_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _asks_too_much(qos: QoSProfile, publishers: Sequence[TopicEndpointInfo]) -> bool:
    acceptable = _acceptable_qos(publishers)
    loses_reliability = acceptable.reliability != qos.reliability == ReliabilityPolicy.RELIABLE
    return loses_reliability or acceptable.durability != qos.durability == DurabilityPolicy.TRANSIENT_LOCAL


def _offered(profile: QoSProfile) -> OfferedQos:
    return OfferedQos(
        history=profile.history.short_key,
        depth=profile.depth,
        reliability=profile.reliability.short_key,
        durability=profile.durability.short_key,
        deadline_ns=profile.deadline.nanoseconds,
        lifespan_ns=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.short_key,
        liveliness_lease_ns=profile.liveliness_lease_duration.nanoseconds,
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise BagError(f"parameter custom_data, entry '{text}': expected key=value")
    return key, value


if __name__ == "__main__":
    sys.exit(main())
