"""Publishes the messages of a bag under /replay at their times, without decoding them."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import closing

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool, Trigger

from contact_reach_ros.bags.playback import Playback, read_ahead
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import OfferedQos
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.timing import NANOSECONDS

_MATCHED_S = 1.0
_SHOW_S = 0.2
_ARRIVAL_S = 1.0
_PERCENTILES = {"p50": 50.0, "p99": 99.0}
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
        ticks = {name for name in chosen if topics.find(name, [topics.JOINT_STATES])}
        self._playback = Playback(options.rate, ticks or set(chosen), options.paused)
        known = reader.topics()
        self._profiles = {name: publisher_qos(name, known[name].offered_qos) for name in chosen}
        self._publishers: dict[str, Publisher] = {
            name: node.create_publisher(kind, published_name(name), self._profiles[name])
            for name, kind in chosen.items()
        }
        self._loops = 0
        self._end_ns = reader.summary.start_ns + int(reader.summary.duration * NANOSECONDS)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_service(SetBool, "~/pause", self._on_pause)
        node.create_service(Trigger, "~/step", self._on_step)
        if options.clock is not None:
            name = published_name(f"/{topics.CLOCK.name}")
            self._clock = node.create_publisher(ClockMessage, name, qos_profile(topics.CLOCK.qos))
            node.create_timer(1.0 / options.clock, self._publish_time, clock=self._steady)

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
        with _progress() as progress:
            self._show_on(progress, start_ns)
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

    def _show_on(self, progress: Progress, start_ns: int) -> None:
        """Show the position on a terminal, some times a second, also in a pause."""
        task = progress.add_task("", total=(self._end_ns - start_ns) / NANOSECONDS, word="")

        def show() -> None:
            position_ns = min(max(self._playback.position_ns, start_ns), self._end_ns)
            word = "paused" if self._playback.paused else ""
            progress.update(task, completed=(position_ns - start_ns) / NANOSECONDS, word=word, refresh=True)

        self._node.create_timer(_SHOW_S, show, clock=self._steady)

    def _publish_time(self) -> None:
        position_ns = self._playback.position_ns
        if position_ns:
            self._clock.publish(ClockMessage(clock=to_time(min(position_ns, self._end_ns))))

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._playback.pause()
        else:
            self._playback.resume()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._playback.step()
        response.message = "stepped" if response.success else f"pause first: call {REPLAY}/pause with data true"
        return response

    def _report(self, seconds: float) -> None:
        playback = self._playback
        late = playback.late
        ended = f", {self._loops + 1} times" if self._loops else ""
        print(f"{REPLAY}: {playback.count} messages of {len(self._publishers)} topics in {seconds:.1f} s{ended}")
        if late.count:
            numbers = ", ".join(f"{name} {late.percentile_us(value):.0f}" for name, value in _PERCENTILES.items())
            print(f"{REPLAY}: behind their time by {numbers}, at most {late.maximum_ns / 1000:.0f} us")
        if playback.stalls:
            print(f"{REPLAY}: delayed by more than 0.5 s {playback.stalls} times", file=sys.stderr)
        for note in self._reader.notes:
            if note not in self._reader.summary.notes:
                print(f"{REPLAY}: {note}", file=sys.stderr)


def _progress() -> Progress:
    """A bar of seconds, with a word, which appears on a terminal only."""
    columns = (
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[word]}"),
    )
    return Progress(*columns, console=Console(stderr=True), auto_refresh=False, disable=not sys.stderr.isatty())


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
