"""The recorder: writes the topics of the stack to a bag until it is stopped."""

from __future__ import annotations

import datetime
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.utilities import get_rmw_implementation_identifier

from contact_reach_ros.bags.settings import MEGA, RECORDER_SECTIONS, RecorderSettings, shortage_in
from contact_reach_ros.bags.topics import LOST, RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.cdr import stamp_in
from contact_reach_ros.messages.topics import Qos, Topic
from contact_reach_ros.resources import versions
from contact_reach_ros.ros.inbox import LoopGroup, qos_profile
from contact_reach_ros.ros.lockstep import FOREVER_NS, promise
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.process import run
from contact_reach_ros.timing import NANOSECONDS

DRAIN_PERIOD = 0.02
DISCOVERY_PERIOD = 0.1
AHEAD_NS = NANOSECONDS // 2
"""Simulated time that the recorder may lag behind: its queues hold 4000 messages, and a tick has up to three each."""
FLUSH_PERIOD = 0.5
"""A recorder that is killed loses the messages of this time, s; a power cut also what the disk was about to write."""
SETTLING_TIME = 0.05
"""Time to wait for messages in transit when the recording ends, s."""
HISTORY_DEPTH = topics.KEPT_STREAM.depth
"""Messages per topic that wait in the middleware while the recorder is held up: all that publishers keep, or 4 s."""


class RecorderNode(ManagedNode):
    """Records from its activation to its deactivation."""

    NAME = "recorder"
    SECTIONS = RECORDER_SECTIONS

    def __init__(self) -> None:
        super().__init__()
        self._promises = self.make_publisher(topics.LOCKSTEP_HORIZON) if self.lockstep else None
        self._promised_ns = 0
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
        made_by = yaml.safe_dump({**versions(), "rmw": get_rmw_implementation_identifier()})
        custom_data = {"versions": made_by, **settings.texts()}
        shortage = shortage_in(directory)
        if shortage:
            raise BagError(f"bag '{directory}' is not begun: {shortage}")
        self._recorder = TopicRecorder(self, BagWriter(directory, custom_data=custom_data))
        self._next_discovery = self._next_flush = time.monotonic()
        self.get_logger().info(f"recording to {directory}")

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

    def _record(self, recorder: TopicRecorder) -> None:
        now = time.monotonic()
        if now >= self._next_discovery:
            self._next_discovery = now + DISCOVERY_PERIOD
            recorder.discover()
        recorder.drain()
        self._promise(recorder.stamp_ns + AHEAD_NS)
        if now >= self._next_flush:
            self._next_flush = now + FLUSH_PERIOD
            recorder.flush()
            self._ended_early = shortage_in(recorder.writer.directory)
            if self._ended_early:
                # Others need the disk as well, and the end of a recording is not a reason to stop the arm.
                self.get_logger().error(f"the recording ends here: {self._ended_early}")
                self._complete()

    def _promise(self, until_ns: int) -> None:
        """Let simulated time pass until then."""
        if self._promises is not None and until_ns != self._promised_ns:
            self._promised_ns = until_ns
            self._promises.publish(promise(self.NAME, min(until_ns, FOREVER_NS)))

    def deactivate(self) -> None:
        """Write what is still in transit and complete the bag; raises `BagError` if writing fails."""
        with self._lock:
            self._complete()

    def _complete(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return
        self._promise(FOREVER_NS)
        recorder.stop()
        written, directory = recorder.writer.message_count, recorder.writer.directory
        size = sum(file.stat().st_size for file in directory.iterdir()) / MEGA
        line = f"recorded {written} messages ({recorder.lost} lost), {size:.1f} MB, in {directory}"
        self.get_logger().info(line)


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


class _Recorded(NamedTuple):
    name: str
    kind: type
    qos: Qos
    subscription: Subscription
    loss: LossCounter


class TopicRecorder:
    """Moves the messages of the stack's topics to a bag.

    Parameters
    ----------
    node :
        Owner of the subscriptions.
    writer :
        The bag, which `stop` closes.

    Attributes
    ----------
    stamp_ns :
        Of the last joint state that is in the bag; 0 before the first.
    """

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self.writer = writer
        self.stamp_ns = 0
        self._node = node
        # Waking up for every message costs ten times as much as taking those gathered in 20 ms.
        self._group = LoopGroup()
        self._topics: dict[str, Topic | None] = {
            **dict.fromkeys(map(node.resolve_topic_name, topics.OF_OTHERS)),
            **{node.resolve_topic_name(topic.name): topic for topic in topics.ALL},
        }
        """By full name; None until the first publisher tells the type."""
        self._states = self._name_in_bag(topics.JOINT_STATES)
        self._publisher_counts = dict.fromkeys(self._topics, 0)
        self._recorded: dict[str, _Recorded] = {}

    @property
    def lost(self) -> int:
        """Number of messages that were sent while their topic was recorded, but did not arrive."""
        return sum(recorded.loss.lost for recorded in self._recorded.values())

    def discover(self) -> None:
        """Subscribe to the topics that have got publishers since the last call; raises `BagError` if writing fails."""
        for name, known in self._topics.items():
            # Counting is cheap; the publishers' offers are looked up only when their number has changed.
            if self._node.count_publishers(name) == self._publisher_counts[name]:
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            self._publisher_counts[name] = len(publishers)
            topic = self._topics[name] = known or self._of_others(name, publishers)
            if topic is None:
                continue
            offered = [publisher.qos_profile for publisher in publishers if publisher.topic_type == topic.type_name]
            if len(offered) < len(publishers):
                self._node.get_logger().error(f"not recorded: what is published on '{name}' is no {topic.type_name}")
            if offered:
                self._subscribe(name, topic, offered)

    def drain(self) -> None:
        """Write what has arrived, in the order of arrival; raises `BagError` if writing fails."""
        batch: list[tuple[int, _Recorded, bytes, Any]] = []
        for recorded in self._recorded.values():
            handle = recorded.subscription.handle
            with handle:
                for _ in range(HISTORY_DEPTH):
                    taken = handle.take_message(recorded.kind, True)
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
        self.writer.flush()

    def stop(self) -> None:
        """Write what is still in transit, complete the bag and unsubscribe; raises `BagError` if writing fails."""
        with self.writer:
            self.drain()
            time.sleep(SETTLING_TIME)
            self.drain()
            self._note_losses()
        for recorded in self._recorded.values():
            self._node.destroy_subscription(recorded.subscription)

    def _of_others(self, name: str, publishers: Sequence[TopicEndpointInfo]) -> Topic | None:
        """A topic of the type of its first publisher; None, with a line in the log, if that is not installed."""
        if not publishers:
            return None
        latched = all(one.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in publishers)
        topic = Topic(name, publishers[0].topic_type, topics.ALL_EVENTS if latched else topics.STREAM)
        if topic.type is None:
            what = f"'{name}', as {topic.type_name} is not installed"
            self._node.get_logger().error(f"not recorded: {what}; source the workspace that has it")
            return None
        return topic

    def _note_losses(self) -> None:
        known = all(recorded.loss.known for recorded in self._recorded.values())
        self.writer.set_custom_data(LOST, str(self.lost) if known else "unknown")
        for recorded in self._recorded.values():
            if recorded.loss.lost:
                self.writer.set_custom_data(f"{LOST}{recorded.name}", str(recorded.loss.lost))

    def _subscribe(self, name: str, topic: Topic, offered: Sequence[QoSProfile]) -> None:
        """Request the strictest quality of service that every publisher offers, and has offered so far.

        Streams are latched where time is simulated only, and the driver of a real arm may offer best effort.
        """
        before = self._recorded.get(name)
        least = Qos(HISTORY_DEPTH, latched=True) if before is None else before.qos
        reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
        latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)
        qos = Qos(HISTORY_DEPTH, least.reliable and reliable, least.latched and latched)
        if before is None:
            kept = RecordedTopic(self._name_in_bag(topic), topic.type_name, topic.qos.depth, topic.qos.latched)
            self.writer.add_topic(kept)
        elif qos == before.qos:
            return
        else:
            self.drain()
            self._node.destroy_subscription(before.subscription)
        subscription = self._node.create_subscription(
            topic.type, name, lambda _: None, qos_profile(qos), callback_group=self._group, raw=True
        )
        loss = LossCounter() if before is None else before.loss
        self._recorded[name] = _Recorded(self._name_in_bag(topic), topic.type, qos, subscription, loss)

    def _name_in_bag(self, topic: Topic) -> str:
        """The stack's own name of a topic, whatever it is remapped to, so that whoever reads the bag finds it."""
        own: str = self._node.resolve_topic_name(topic.name, only_expand=True)
        return own


if __name__ == "__main__":
    sys.exit(run(RecorderNode, sys.argv))
