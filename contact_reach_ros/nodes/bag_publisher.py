"""Publishes the messages of a bag under /replay at their times, without decoding them."""

from __future__ import annotations

import argparse
import json
import os
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool, Trigger

from contact_reach_ros.bags.playback import Playback, read_ahead
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.nodes.recorded_qos import publisher_qos
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.ros.qos import qos_profile
from contact_reach_ros.ros.scheduling import request_realtime
from contact_reach_ros.units import NANOSECONDS

PRIORITY = 26
"""Of the publishing thread, below everything that an arm depends on; that of the other threads is lower by one."""

_MATCHED_S = 1.0
_SPIN_S = 0.05
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
        self._chosen = chosen
        self._options = options
        ticks = {name for name in chosen if topics.find(name, [topics.JOINT_STATES])}
        self._playback = Playback(options.rate, ticks or set(chosen), options.paused)
        known = reader.topics()
        self._profiles = {name: publisher_qos(name, known[name].offered_qos) for name in chosen}
        self._publishers: dict[str, Publisher] = {}
        self._loops = 0
        self._real_time = False
        self._end_ns = reader.summary.start_ns + int(reader.summary.duration * NANOSECONDS)

    def run(self, start_ns: int, ended: queue.SimpleQueue[BaseException | None]) -> int:
        """Publish from a time of the recording on, ns, until its end or until an entry is in the queue.

        Raises `ContactReachError` if the bag cannot be read.
        """
        self._publishers = {
            name: self._node.create_publisher(kind, published_name(name), self._profiles[name])
            for name, kind in self._chosen.items()
        }
        self._serve()
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        playing = threading.Thread(target=self._play, args=[start_ns, ended], name="player")
        sys.setswitchinterval(_SWITCH_S)
        # At a higher rate the publishing thread may never sleep.
        if self._options.rate <= 1.0:
            warning = request_realtime(PRIORITY - 1)
            self._real_time = not warning
            if warning:
                self._node.get_logger().warning(warning)
        # Subscriptions have to be matched before the first message.
        time.sleep(_MATCHED_S)
        began = time.monotonic()
        playing.start()
        try:
            self._watch(executor, start_ns, ended)
        finally:
            self._playback.stop()
            playing.join()
            executor.shutdown()
            self._report(time.monotonic() - began)
        failure = ended.get()
        if failure is not None:
            raise failure
        return 0

    def _play(self, start_ns: int, ended: queue.SimpleQueue[BaseException | None]) -> None:
        try:
            self._prioritise(PRIORITY)
            for message in self._latched_before(start_ns):
                self._publish(message)
            while self._play_once(start_ns) and self._options.loop:
                self._loops += 1
            if not self._options.loop:
                for publisher in self._publishers.values():
                    publisher.wait_for_all_acked(Duration(seconds=_ARRIVAL_S))
            ended.put(None)
        except BaseException as error:  # handed to the main thread, which ends the process with it
            ended.put(error)

    def _play_once(self, start_ns: int) -> bool:
        stored = self._reader.raw_messages(list(self._chosen), start_ns)
        # With the same priority as this one, the thread that reads ahead would keep it from running.
        with closing(read_ahead(stored, lambda: self._prioritise(PRIORITY - 1))) as messages:
            return self._playback.run(messages, start_ns, self._publish)

    def _publish(self, message: RawMessage) -> None:
        self._publishers[message.topic].publish(message.data)

    def _prioritise(self, priority: int) -> None:
        """Set the priority of the calling thread, where the system permits it."""
        if self._real_time:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

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

    def _watch(
        self, executor: SingleThreadedExecutor, start_ns: int, ended: queue.SimpleQueue[BaseException | None]
    ) -> None:
        """Answer services and show progress until the end."""
        end_ns = self._end_ns
        with _progress((end_ns - start_ns) / NANOSECONDS) as show:
            show_at = time.monotonic()
            while ended.empty():
                executor.spin_once(timeout_sec=_SPIN_S)
                now = time.monotonic()
                if now >= show_at:
                    position = min(max(self._playback.position_ns, start_ns), end_ns)
                    show((position - start_ns) / NANOSECONDS, "paused" if self._playback.paused else "")
                    show_at = now + _SHOW_S

    def _serve(self) -> None:
        self._node.create_service(SetBool, "~/pause", self._on_pause)
        self._node.create_service(Trigger, "~/step", self._on_step)
        if self._options.clock is not None:
            name = published_name(f"/{topics.CLOCK.name}")
            publisher = self._node.create_publisher(ClockMessage, name, qos_profile(topics.CLOCK.qos))
            steady = Clock(clock_type=ClockType.STEADY_TIME)

            def publish_time() -> None:
                position_ns = self._playback.position_ns
                if position_ns:
                    publisher.publish(ClockMessage(clock=to_time(min(position_ns, self._end_ns))))

            self._node.create_timer(1.0 / self._options.clock, publish_time, clock=steady)

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
        print(f"{REPLAY}: {playback.count} messages of {len(self._chosen)} topics in {seconds:.1f} s{ended}")
        if late.count:
            numbers = ", ".join(f"{name} {late.percentile_us(value):.0f}" for name, value in _PERCENTILES.items())
            print(f"{REPLAY}: behind their time by {numbers}, at most {late.maximum_ns / 1000:.0f} us")
        if playback.stalls:
            print(f"{REPLAY}: delayed by more than 0.5 s {playback.stalls} times", file=sys.stderr)
        for note in self._reader.notes:
            if note not in self._reader.summary.notes:
                print(f"{REPLAY}: {note}", file=sys.stderr)
        if self._options.json is not None:
            content = {
                "messages": playback.count,
                "topics": len(self._chosen),
                "seconds": seconds,
                "late_us": {**late.summary(), "max": late.maximum_ns / 1000},
                "stalls": playback.stalls,
            }
            self._options.json.write_text(json.dumps(content, indent=2) + "\n")


@contextmanager
def _progress(duration: float) -> Iterator[Any]:
    """Show progress in seconds, and a word, on a terminal."""
    if not sys.stderr.isatty():
        yield lambda seconds, word: None
        return
    columns = (
        BarColumn(),
        TextColumn("{task.completed:.1f} of {task.total:.1f} s"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[word]}"),
    )
    with Progress(*columns, console=Console(stderr=True), auto_refresh=False) as progress:
        task = progress.add_task("", total=duration, word="")

        def show(seconds: float, word: str) -> None:
            progress.update(task, completed=seconds, word=word, refresh=True)

        yield show
