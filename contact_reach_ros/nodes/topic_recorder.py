"""Moves messages from the middleware to a bag without decoding them."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.bags.topics import LOST, OfferedQos, RecordedTopic, check_type_name
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.cdr import stamp_in
from contact_reach_ros.messages.topics import JOINT_STATES, KEPT_STREAM
from contact_reach_ros.ros.inbox import LoopGroup
from contact_reach_ros.ros.lockstep import FOREVER_NS

SETTLING_TIME = 0.05
"""Time to wait for messages in transit when the recording ends, s."""
HISTORY_DEPTH = KEPT_STREAM.depth
"""Messages per topic that wait in the middleware while the recorder is held up: all that publishers keep, or 4 s."""


class LossCounter:
    """Finds gaps in the sequence numbers of the messages of one topic.

    Each publisher numbers its own messages, and a message does not name its publisher; so the counter keeps one
    expected number for each publisher seen.

    Attributes
    ----------
    lost :
        Number of messages that were sent while the topic was recorded and did not arrive.
    known :
        False after a message without a number (some middlewares send none): then `lost` is a lower bound.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.known = True
        # A list, not a set: two publishers may have reached the same number.
        self._expected: list[int] = []

    def count(self, sequence: int | None, publishers: Callable[[], int]) -> None:
        """Count one message; messages must be passed in the order of arrival.

        Parameters
        ----------
        sequence :
            Its publisher's number of the message, None if it has none.
        publishers :
            Returns the current number of publishers; called only when a number is out of sequence.
        """
        if sequence is None:
            self.known = False
            return
        if sequence in self._expected:
            self._expected.remove(sequence)
        elif len(self._expected) >= publishers():
            # No publisher is new: a known one skipped numbers, or was replaced by one with a count of its own.
            earlier = [number for number in self._expected if number < sequence]
            if earlier:
                self.lost += sequence - max(earlier)
            if self._expected:
                self._expected.remove(max(earlier, default=min(self._expected)))
        self._expected.append(sequence + 1)


@dataclasses.dataclass
class _Recorded:
    name: str
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
        The bag, which `stop` closes.
    topics :
        Full names.

    Attributes
    ----------
    stamp_ns :
        Of the last joint state that is in the bag; None before the first, `FOREVER_NS` if none are recorded.
    """

    def __init__(self, node: Node, writer: BagWriter, topics: Sequence[str]) -> None:
        self.writer = writer
        self._node = node
        # Waking up for every message costs ten times as much as taking those gathered in 20 ms.
        self._group = LoopGroup()
        self._recorded: dict[str, _Recorded] = {}
        self._publisher_counts: dict[str, int] = {}
        self._wanted = topics
        self._states = node.resolve_topic_name(JOINT_STATES.name)
        self.stamp_ns: int | None = None if self._states in self._wanted else FOREVER_NS

    @property
    def lost(self) -> int:
        """Number of messages that were sent while their topic was recorded, but did not arrive."""
        return sum(recorded.loss.lost for recorded in self._recorded.values())

    def discover(self) -> None:
        """Subscribe to the wanted topics that have appeared since the last call; raises `BagError` if writing fails."""
        for name in self._wanted:
            # Counting is cheap; the publishers' offers are looked up only when their number has changed.
            count = self._node.count_publishers(name)
            if count == self._publisher_counts.get(name, 0):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            self._publisher_counts[name] = len(publishers)
            if publishers and name not in self._recorded:
                try:
                    self._begin(name, publishers)
                except BagError as error:
                    self._node.get_logger().error(f"not recorded: {error}")
            elif publishers:
                self._relax(self._recorded[name], acceptable_qos(publishers))

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
            self.writer.write(recorded.name, data, received_ns, sent_ns, sequence or 0)
            if recorded.name == self._states:
                self.stamp_ns = stamp_in(data)

    def flush(self) -> None:
        """Note in the bag what was lost so far, and start writing it to the disk; raises `BagError` if that fails."""
        self._note_losses()
        self.writer.flush(durable=True)

    def stop(self) -> None:
        """Write what is still in transit, complete the bag and unsubscribe; raises `BagError` if writing fails."""
        with self.writer:
            self.drain()
            time.sleep(SETTLING_TIME)
            self.drain()
            self._note_losses()
        for recorded in self._recorded.values():
            self._node.destroy_subscription(recorded.subscription)

    def _note_losses(self) -> None:
        known = all(recorded.loss.known for recorded in self._recorded.values())
        self.writer.set_custom_data(LOST, str(self.lost) if known else "unknown")
        for name, recorded in self._recorded.items():
            if recorded.loss.lost:
                self.writer.set_custom_data(f"{LOST}{name}", str(recorded.loss.lost))

    def _begin(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        types = sorted({publisher.topic_type for publisher in publishers})
        if len(types) > 1:
            raise BagError(f"topic '{name}' has the types {', '.join(types)}, expected one")
        kind = message_class(types[0])
        qos = acceptable_qos(publishers)
        self.writer.add_topic(RecordedTopic(name, types[0], tuple(map(_offered_qos, publishers))))
        self._recorded[name] = _Recorded(name, kind, qos, self._subscribe(name, kind, qos), LossCounter())

    def _relax(self, recorded: _Recorded, acceptable: QoSProfile) -> None:
        """Subscribe again if a publisher has joined that offers less: the earlier request would not match it."""
        loses_reliability = acceptable.reliability != recorded.qos.reliability == ReliabilityPolicy.RELIABLE
        loses_latching = acceptable.durability != recorded.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        if loses_reliability or loses_latching:
            self.drain()
            self._node.destroy_subscription(recorded.subscription)
            recorded.qos = acceptable
            recorded.subscription = self._subscribe(recorded.name, recorded.message_class, acceptable)

    def _subscribe(self, name: str, kind: type, qos: QoSProfile) -> Subscription:
        return self._node.create_subscription(kind, name, lambda _: None, qos, callback_group=self._group, raw=True)


def acceptable_qos(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest quality of service that every publisher offers, with a deep queue."""
    offered = [publisher.qos_profile for publisher in publishers]
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
    latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)
    return QoSProfile(
        depth=HISTORY_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def message_class(type_name: str) -> type:
    """Return the class of a message type; raises `BagError` if the type is not installed."""
    package, _, name = check_type_name(type_name).split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f"message type '{type_name}' is not installed; source the workspace that has it") from error


def _offered_qos(publisher: TopicEndpointInfo) -> OfferedQos:
    qos = publisher.qos_profile
    return OfferedQos(qos.history.short_key, qos.depth, qos.reliability.short_key, qos.durability.short_key)
