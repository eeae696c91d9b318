"""Publishes the messages of a bag under /replay at their times, without decoding them."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import closing

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool

from contact_reach_ros.bags.playback import Playback, read_ahead
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import OfferedQos
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.interfaces import REPLAY

_MATCHED_S = 1.0
_ARRIVAL_S = 1.0
_SWITCH_S = 1e-4
"""Switching interval of the interpreter: the thread that reads ahead must not delay the one that publishes."""


def published_name(recorded: str) -> str:
    """Name under which a recorded topic is published: no arm listens there."""
    return f"/{REPLAY}{recorded}"


class BagPublisher:
    """Publishes a bag, each topic under `published_name`.

    Parameters
    ----------
    node
        Publishes; its executor must not be spun by others.
    reader
        The bag.
    chosen
        Topics to publish, with their message classes.
    options
        See `make_parser`.
    """

    def __init__(self, node: Node, reader: BagReader, chosen: dict[str, type], options: argparse.Namespace) -> None:
        self._node = node
        self._reader = reader
        self._options = options
        self._playback = Playback(options.rate, options.paused)
        known = reader.topics()
        self._profiles = {name: publisher_qos(name, known[name].offered_qos) for name in chosen}
        self._publishers: dict[str, Publisher] = {
            name: node.create_publisher(kind, published_name(name), self._profiles[name])
            for name, kind in chosen.items()
        }
        self._loops = 0
        node.create_service(SetBool, "~/pause", self._on_pause)

    def stop(self) -> None:
        """End `run`; may be called by a signal handler."""
        self._playback.stop()

    def run(self, start_ns: int) -> None:
        """Publish from a time of the recording on, ns since the epoch, until its end or `stop`.

        Raises `BagError` if the bag cannot be read.
        """
        sys.setswitchinterval(_SWITCH_S)
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        serving = threading.Thread(target=executor.spin, name="services")
        serving.start()
        try:
            # Subscriptions have to be matched before the first message.
            time.sleep(_MATCHED_S)
            began = time.monotonic()
            self._play(start_ns)
            seconds = time.monotonic() - began
        finally:
            executor.shutdown()
            serving.join()
        self._report(seconds)

    def _play(self, start_ns: int) -> None:
        for message in self._latched_before(start_ns):
            self._publish(message)
        while self._play_once(start_ns):
            if not self._options.loop:
                for publisher in self._publishers.values():
                    publisher.wait_for_all_acked(Duration(seconds=_ARRIVAL_S))
                return
            self._loops += 1

    def _play_once(self, start_ns: int) -> bool:
        """Publish once; returns whether the end was reached."""
        stored = self._reader.raw_messages(list(self._publishers), start_ns)
        with closing(read_ahead(stored)) as messages:
            return self._playback.run(messages, start_ns, self._publish)

    def _publish(self, message: RawMessage) -> None:
        self._publishers[message.topic].publish(message.data)

    def _latched_before(self, start_ns: int) -> list[RawMessage]:
        """Messages of the skipped part that latched topics would still show."""
        kept: dict[str, deque[RawMessage]] = {
            name: deque(maxlen=profile.depth)
            for name, profile in self._profiles.items()
            if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        }
        if start_ns > self._reader.summary.start_ns:
            for message in self._reader.raw_messages(list(kept)):
                if message.log_time_ns >= start_ns:
                    break
                kept[message.topic].append(message)
        return sorted((message for messages in kept.values() for message in messages), key=lambda raw: raw.log_time_ns)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._playback.pause()
        else:
            self._playback.resume()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _report(self, seconds: float) -> None:
        count, ended = self._playback.count, f", {self._loops + 1} times" if self._loops else ""
        print(f"{REPLAY}: {count} messages of {len(self._publishers)} topics in {seconds:.1f} s{ended}")
        for note in self._reader.notes:
            if note not in self._reader.summary.notes:
                print(f"{REPLAY}: {note}", file=sys.stderr)


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
