"""Publishes the messages of a bag under /replay at their times, without decoding them."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Generator, Iterable, Sequence

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import OfferedQos
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.timing import NANOSECONDS

_MATCHED_S = 1.0
_ARRIVAL_S = 1.0
_STALLED_NS = 500_000_000
"""A longer delay, as of a process that was suspended with Ctrl-Z, is not made up for."""


def published_name(recorded: str) -> str:
    """Name under which a recorded topic is published: no arm listens there."""
    return f"/{REPLAY}{recorded}"


class BagPublisher:
    """Publishes a bag, each topic under `published_name`.

    Parameters
    ----------
    node
        Publishes.
    reader
        The bag.
    chosen
        Topics to publish, with their message classes.
    rate
        Recorded time per real time.
    """

    def __init__(self, node: Node, reader: BagReader, chosen: dict[str, type], rate: float) -> None:
        self._reader, self._known_notes = reader, reader.notes
        self._rate = rate
        self._stopped = threading.Event()
        known = reader.topics
        self._profiles = {name: publisher_qos(name, known[name].offered_qos) for name in chosen}
        self._publishers: dict[str, Publisher] = {
            name: node.create_publisher(kind, published_name(name), self._profiles[name])
            for name, kind in chosen.items()
        }

    def stop(self) -> None:
        """End `run`; may be called by a signal handler."""
        self._stopped.set()

    def run(self, start_ns: int, loop: bool) -> None:
        """Publish from a time of the recording on, ns since the epoch, until its end, or with `loop` until `stop`.

        Raises `BagError` if the bag cannot be read.
        """
        # Subscriptions have to be matched before the first message.
        self._stopped.wait(_MATCHED_S)
        began, count, rounds = time.monotonic(), 0, 0
        for message in self._latched_before(start_ns):
            self._publish(message)
        while not self._stopped.is_set() and (loop or not rounds):
            stored = self._reader.raw_messages(list(self._publishers), start_ns)
            for message in paced(stored, start_ns, self._rate, self._stopped):
                self._publish(message)
                count += 1
            rounds += 1
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_ARRIVAL_S))
        seconds = time.monotonic() - began
        print(f"{REPLAY}: {count} messages of {len(self._publishers)} topics in {seconds:.1f} s, {rounds} times")
        for note in self._reader.notes:
            if note not in self._known_notes:
                print(f"{REPLAY}: {note}", file=sys.stderr)

    def _publish(self, message: RawMessage) -> None:
        self._publishers[message.topic].publish(message.data)

    def _latched_before(self, start_ns: int) -> list[RawMessage]:
        """Messages of the skipped part that latched topics would still show."""
        kept: dict[str, deque[RawMessage]] = {
            name: deque(maxlen=profile.depth)
            for name, profile in self._profiles.items()
            if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        }
        if start_ns > self._reader.start_ns:
            for message in self._reader.raw_messages(list(kept)):
                if message.log_time_ns >= start_ns:
                    break
                kept[message.topic].append(message)
        return sorted((message for messages in kept.values() for message in messages), key=lambda raw: raw.log_time_ns)


def paced(
    messages: Iterable[RawMessage], start_ns: int, rate: float, stopped: threading.Event
) -> Generator[RawMessage, None, None]:
    """Yield each message when it is due, until the end or until `stopped` is set.

    Every message has an absolute deadline on the steady clock, so that delays do not add up.

    Parameters
    ----------
    messages :
        In the order of reception; one that follows a later one is handed out together with it.
    start_ns :
        Time of the recording to begin at, ns since the epoch.
    rate :
        Recorded time per real time, 1 for the original pace.
    stopped :
        Ends the playback.
    """
    began_ns = time.monotonic_ns()
    for message in messages:
        remaining_ns = began_ns + int((message.log_time_ns - start_ns) / rate) - time.monotonic_ns()
        if remaining_ns < -_STALLED_NS:
            began_ns -= remaining_ns
        if stopped.wait(max(remaining_ns, 0) / NANOSECONDS):
            return
        yield message


def publisher_qos(name: str, offered: Sequence[OfferedQos]) -> QoSProfile:
    """Return the best quality of service that any recorded publisher offered: it reaches everybody they reached.

    A recorder has it from discovery, which does not report depths. The depth is then that of the stack's topic, or one
    message for a latched topic and a deep queue for any other.
    """
    if not offered:
        return QoSProfile(depth=topics.STREAM.depth)
    reliable = any(profile.reliability != "best_effort" for profile in offered)
    latched = any(profile.durability == "transient_local" for profile in offered)
    known = topics.find(name)
    usual = known.qos if known is not None else topics.LATCHED if latched else topics.STREAM
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if any(p.history == "keep_all" for p in offered) else HistoryPolicy.KEEP_LAST,
        depth=max(profile.depth for profile in offered) or usual.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
