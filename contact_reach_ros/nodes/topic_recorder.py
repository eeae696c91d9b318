"""Moves messages from the middleware to a bag without decoding them."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Iterable, Sequence
from operator import itemgetter
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.bags.loss import LOST, LossCounter
from contact_reach_ros.bags.topics import RecordedTopic, check_type_name
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.cdr import stamp_in
from contact_reach_ros.messages.topics import JOINT_STATES
from contact_reach_ros.nodes.recorded_qos import HISTORY_DEPTH, acceptable_qos, asks_too_much, offered_qos
from contact_reach_ros.ros.inbox import LoopGroup
from contact_reach_ros.ros.lockstep import FOREVER_NS

SETTLING_TIME = 0.05
"""Time to wait for messages in transit when the recording ends, s."""


@dataclasses.dataclass
class _Recorded:
    topic: RecordedTopic
    message_class: type
    qos: QoSProfile
    subscription: Subscription
    loss: LossCounter


class TopicRecorder:
    """Moves the messages of topics to a bag.

    Parameters
    ----------
    node :
        Owner of the subscriptions.
    writer :
        The bag; the caller keeps it and closes it after `stop`.
    topics :
        Names, relative ones to be resolved by the node, each with its required type or None.

    Attributes
    ----------
    stamp_ns :
        Of the last joint state that is in the bag; None before the first, `FOREVER_NS` if none are recorded.
    """

    def __init__(self, node: Node, writer: BagWriter, topics: Iterable[tuple[str, str | None]]) -> None:
        self._node = node
        self._writer = writer
        # Waking up for every message costs ten times as much as taking those gathered in 20 ms.
        self._group = LoopGroup()
        self._recorded: dict[str, _Recorded] = {}
        self._publisher_counts: dict[str, int] = {}
        self._wanted = {node.resolve_topic_name(name): type_name for name, type_name in topics}
        self._states = node.resolve_topic_name(JOINT_STATES.name)
        self.stamp_ns: int | None = None if self._states in self._wanted else FOREVER_NS

    def discover(self) -> None:
        """Subscribe to the wanted topics that have appeared since the last call; raises `BagError` if writing fails."""
        for name in self._wanted:
            # Counting is cheap; the publishers' offers are looked up only when their number has changed.
            count = self._node.count_publishers(name)
            if count == self._publisher_counts.get(name, 0):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            self._publisher_counts[name] = len(publishers)
            if publishers:
                self._meet(name, publishers)

    def drain(self) -> None:
        """Write what has arrived, in the order of arrival; raises `BagError` if writing fails."""
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
            if recorded.topic.name == self._states:
                self.stamp_ns = stamp_in(data)

    def stop(self) -> None:
        """Write what is still in transit, note what was lost, and unsubscribe; raises `BagError` if writing fails."""
        self.drain()
        time.sleep(SETTLING_TIME)
        self.drain()
        self.note_losses()
        for recorded in self._recorded.values():
            self._node.destroy_subscription(recorded.subscription)

    def note_losses(self) -> None:
        """Note in the bag how many messages have been lost so far."""
        known = all(recorded.loss.known for recorded in self._recorded.values())
        self._writer.set_custom_data(LOST, str(self.lost) if known else "unknown")
        for name, recorded in self._recorded.items():
            if recorded.loss.lost:
                self._writer.set_custom_data(f"{LOST}{name}", str(recorded.loss.lost))

    @property
    def lost(self) -> int:
        """Number of messages that were sent while their topic was recorded, but did not arrive."""
        return sum(recorded.loss.lost for recorded in self._recorded.values())

    def _meet(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        recorded = self._recorded.get(name)
        if recorded is None:
            try:
                self._begin(name, publishers)
            except BagError as error:
                self._node.get_logger().error(f"not recorded: {error}")
        elif asks_too_much(recorded.qos, publishers):
            # A publisher that offers less has joined: with the previous request, nothing would come from it.
            self.drain()
            self._node.destroy_subscription(recorded.subscription)
            recorded.qos = acceptable_qos(publishers)
            recorded.subscription = self._subscribe(name, recorded.message_class, recorded.qos)

    def _begin(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        types = sorted({publisher.topic_type for publisher in publishers})
        expected = self._wanted[name] or types[0]
        if types != [expected]:
            raise BagError(f"topic '{name}' has the type {', '.join(types)}, expected {expected}")
        recorded_class = message_class(expected)
        qos = acceptable_qos(publishers)
        offered = tuple(offered_qos(publisher.qos_profile) for publisher in publishers)
        topic = RecordedTopic(name, expected, offered)
        self._writer.add_topic(topic)
        subscription = self._subscribe(name, recorded_class, qos)
        self._recorded[name] = _Recorded(topic, recorded_class, qos, subscription, LossCounter())

    def _subscribe(self, name: str, recorded_class: type, qos: QoSProfile) -> Subscription:
        return self._node.create_subscription(
            recorded_class, name, lambda _: None, qos, callback_group=self._group, raw=True
        )


def message_class(type_name: str) -> type:
    """The class of a message type; raises `BagError` if the type is not installed."""
    package, _, name = check_type_name(type_name).split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f"message type '{type_name}' is not installed; source the workspace that has it") from error
