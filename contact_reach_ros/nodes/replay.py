"""Replay: publishes the messages of a bag again, as they were, at the time they had."""

from __future__ import annotations

import argparse
import json
import os
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool, Trigger

from contact_reach_ros.errors import BagError, ContactReachError, InputError
from contact_reach_ros.nodes import topics
from contact_reach_ros.nodes.discovery import CHOICES
from contact_reach_ros.nodes.interfaces import REPLAY
from contact_reach_ros.nodes.managed import initialise
from contact_reach_ros.nodes.messages import to_time
from contact_reach_ros.nodes.realtime import request_realtime
from contact_reach_ros.nodes.replay_guard import Watch
from contact_reach_ros.nodes.topic_recorder import message_class
from contact_reach_ros.recording.bag_reader import CDR, BagReader, RawMessage
from contact_reach_ros.recording.playback import Playback, read_ahead
from contact_reach_ros.recording.topics import INFINITE_NS, OfferedQos
from contact_reach_ros.units import NANOSECONDS

BAD_INPUT = 2
PRIORITY = 26
"""Of the thread that publishes: below everything that an arm depends on. The others have one less."""

_CLOCK_HZ = 100.0
_RATES = (0.01, 100.0)
_MATCHED_S = 1.0
_LOOK_S = 0.05
_TURNS_SHOWN = 4
_ARRIVAL_S = 1.0
_SWITCH_S = 1e-4
"""The thread that reads ahead must not keep the other from being on time."""


def make_parser(program: str) -> argparse.ArgumentParser:
    """What the command line may be."""
    parser = argparse.ArgumentParser(prog=program, description="Publishes a bag's messages as they came.")
    add_options(parser)
    return parser


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `run_replay`."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="a directory with metadata.yaml, or one mcap file")
    parser.add_argument("--rate", type=float, default=1.0, help="recorded time per time, 0.01 to 100 (default: 1)")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="skip the first seconds (default: 0)")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="publish these only (default: all)")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until interrupted")
    parser.add_argument("--paused", action="store_true", help="begin with a pause; see the services")
    parser.add_argument(
        "--clock",
        nargs="?",
        type=float,
        const=_CLOCK_HZ,
        metavar="HZ",
        help=f"publish the recording's time on /clock, where the bag has none (default rate: {_CLOCK_HZ:.0f})",
    )
    parser.add_argument(
        "--allow-motion", action="store_true", help="publish even where a driver, controller or planner would act on it"
    )
    parser.add_argument("--discovery", default="host", choices=CHOICES, help="who hears it (default: host)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write counts and timing as JSON")


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says, and exit with 0 at the end or when interrupted, or with 2 and what is wrong."""
    given = list(sys.argv if arguments is None else [REPLAY, *arguments])
    own = remove_ros_args(given)
    options = make_parser(REPLAY).parse_args(own[1:])
    try:
        # ROS gets all of it, and finds what is its own.
        sys.exit(run_replay(options, [REPLAY, *(given[1:] if len(own) < len(given) else [])]))
    except ContactReachError as error:
        print(f"{REPLAY}: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)


def run_replay(options: argparse.Namespace, arguments: Sequence[str] = (REPLAY,)) -> int:
    """Replay a bag as the options say, until its end, Ctrl-C or SIGTERM; returns the exit code.

    Raises
    ------
    ContactReachError
        If the options or the bag are refused, or something would act on what is replayed.
    """
    ended: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.put(None))
    if not _RATES[0] <= options.rate <= _RATES[1]:
        raise InputError(f"--rate {options.rate:g}: expected {_RATES[0]:g} to {_RATES[1]:g}")
    if options.clock is not None and not 1.0 <= options.clock <= 1000.0:
        raise InputError(f"--clock {options.clock:g}: expected 1 to 1000 Hz")
    reader = BagReader(options.bag)
    for note in reader.notes:
        print(f"{REPLAY}: {note}", file=sys.stderr)
    chosen = choose_topics(reader, options.topics)
    start_ns = reader.summary.start_ns + int(options.start * NANOSECONDS)
    if not 0.0 <= options.start <= reader.summary.duration:
        raise InputError(f"--start {options.start:g}: expected 0 to {reader.summary.duration:.3f} s, which the bag has")
    if options.clock is not None and any(name.endswith("/" + topics.CLOCK.name) for name in chosen):
        raise InputError("--clock: the bag has a /clock of its own, which is replayed; leave the option out")
    initialise(arguments, options.discovery)
    node = Node(REPLAY)
    try:
        replay = Replay(node, reader, chosen, options)
        return replay.run(start_ns, ended)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def choose_topics(reader: BagReader, wanted: Sequence[str] | None) -> dict[str, type]:
    """The message classes of the topics that can be published; says on stderr which of the bag's cannot.

    Raises
    ------
    InputError
        If a wanted topic is not in the bag, or none is left.
    """
    known = reader.topics()
    names = list(known)
    if wanted is not None:
        names = [name if name.startswith("/") else f"/{name}" for name in wanted]
        for name in names:
            if name not in known:
                raise InputError(f"--topics {name}: the bag has no such topic; it has {', '.join(sorted(known))}")
    chosen = {}
    for name in names:
        try:
            if known[name].encoding != CDR:
                raise BagError(f"its messages are {known[name].encoding or 'of no known encoding'}, expected {CDR}")
            chosen[name] = message_class(known[name].type)
        except BagError as error:
            print(f"{REPLAY}: {name} is left out: {error}", file=sys.stderr)
    if not chosen:
        raise InputError(f"{reader.summary.path}: there is no topic that can be published")
    return chosen


class Replay:
    """A bag that is being published.

    Parameters
    ----------
    node
        Which publishes; its executor must not be spun by others.
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
        ticks = {name for name in chosen if name.endswith("/" + topics.JOINT_STATES.name)}
        self._playback = Playback(options.rate, ticks or set(chosen), options.paused)
        self._publishers: dict[str, Publisher] = {}
        self._loops = 0
        self._real_time = False
        self._end_ns = reader.summary.start_ns + int(reader.summary.duration * NANOSECONDS)
        self._watching = None if options.allow_motion else Watch(node, chosen)

    def run(self, start_ns: int, ended: queue.SimpleQueue[BaseException | None]) -> int:
        """Publish from a time of the recording on, ns, until its end or until something is in the queue.

        Raises
        ------
        ContactReachError
            If something would act on what is replayed, or the bag cannot be read.
        """
        if self._watching is not None:
            self._watching.settle(lambda: not ended.empty())
        self._publishers = {
            name: self._node.create_publisher(kind, name, publisher_qos(name, self._reader.topics()[name].offered_qos))
            for name, kind in self._chosen.items()
        }
        self._serve()
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        serving = threading.Thread(target=_spin, args=[executor], name="services")
        playing = threading.Thread(target=self._play, args=[start_ns, ended], name="player")
        sys.setswitchinterval(_SWITCH_S)
        serving.start()
        # Where messages are to come faster than they did, this thread may never sleep.
        if self._options.rate <= 1.0:
            warning = request_realtime(PRIORITY - 1)
            self._real_time = not warning
            if warning:
                self._node.get_logger().warning(warning)
        began = time.monotonic()
        try:
            # Subscriptions have to be matched before the first message.
            time.sleep(_MATCHED_S)
            playing.start()
            failure = self._watch(start_ns, ended)
        finally:
            self._playback.stop()
            if playing.is_alive():
                playing.join()
            executor.shutdown()
            serving.join()
        self._report(time.monotonic() - began - _MATCHED_S)
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
        publisher = self._publishers[message.topic]
        if self._watching is not None:
            self._watching.admit(message.topic, publisher)
        publisher.publish(message.data)

    def _prioritise(self, priority: int) -> None:
        """For the calling thread, where the system permits it."""
        if self._real_time:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

    def _latched_before(self, start_ns: int) -> list[RawMessage]:
        """What latched topics would still show of the part that is skipped."""
        known = self._reader.topics()
        kept: dict[str, deque[RawMessage]] = {}
        for name in self._chosen:
            profile = publisher_qos(name, known[name].offered_qos)
            if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                kept[name] = deque(maxlen=profile.depth)
        if start_ns > self._reader.summary.start_ns:
            for message in self._reader.raw_messages(list(kept)):
                if message.log_time_ns >= start_ns:
                    break
                kept[message.topic].append(message)
        return sorted((message for messages in kept.values() for message in messages), key=lambda raw: raw.log_time_ns)

    def _watch(self, start_ns: int, ended: queue.SimpleQueue[BaseException | None]) -> BaseException | None:
        """Show how far it is and look who listens until the end; returns what went wrong."""
        end_ns = self._end_ns
        with _progress((end_ns - start_ns) / NANOSECONDS) as show:
            turn = 0
            while True:
                turn += 1
                try:
                    return ended.get(timeout=_LOOK_S)
                except queue.Empty:
                    pass
                try:
                    if self._watching is not None:
                        self._watching.check_next()
                except InputError as error:
                    return error
                if turn % _TURNS_SHOWN == 0:
                    position = min(max(self._playback.position_ns, start_ns), end_ns)
                    show((position - start_ns) / NANOSECONDS, "paused" if self._playback.paused else "")

    def _serve(self) -> None:
        self._node.create_service(SetBool, "~/pause", self._on_pause)
        self._node.create_service(Trigger, "~/step", self._on_step)
        if self._options.clock is not None:
            publisher = self._node.create_publisher(ClockMessage, "/" + topics.CLOCK.name, topics.CLOCK.qos)
            steady = Clock(clock_type=ClockType.STEADY_TIME)

            def tell() -> None:
                position_ns = self._playback.position_ns
                if position_ns:
                    publisher.publish(ClockMessage(clock=to_time(min(position_ns, self._end_ns))))

            self._node.create_timer(1.0 / self._options.clock, tell, clock=steady)

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
            print(f"{REPLAY}: it stood still for more than 0.5 s {playback.stalls} times", file=sys.stderr)
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


_PERCENTILES = {"p50": 50.0, "p99": 99.0}


def publisher_qos(name: str, offered: Sequence[OfferedQos]) -> QoSProfile:
    """Terms that reach everybody whom the recorded publishers reached: the best that any of them offered.

    Discovery, from which a recorder has them, does not tell the depth of a queue. Then it is that of the stack's topic,
    or one message for a latched topic and a deep queue for any other.
    """
    if not offered:
        return QoSProfile(depth=topics.STREAM.depth)
    reliable = any(profile.reliability != "best_effort" for profile in offered)
    latched = any(profile.durability == "transient_local" for profile in offered)
    first = offered[0]
    by_hand = first.liveliness == "manual_by_topic"
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if any(p.history == "keep_all" for p in offered) else HistoryPolicy.KEEP_LAST,
        depth=max(profile.depth for profile in offered) or _usual_depth(name, latched),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        deadline=_duration(first.deadline_ns),
        lifespan=_duration(first.lifespan_ns),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if by_hand else LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=_duration(first.liveliness_lease_ns),
        avoid_ros_namespace_conventions=first.avoid_ros_namespace_conventions,
    )


def _usual_depth(name: str, latched: bool) -> int:
    depths = [topic.qos.depth for topic in topics.ALL if name.endswith(f"/{topic.name}")]
    return depths[0] if depths else topics.LATCHED.depth if latched else topics.STREAM.depth


def _duration(nanoseconds: int) -> Duration:
    # rmw takes zero for no limit, and older files have it, too.
    return Duration() if nanoseconds >= INFINITE_NS - NANOSECONDS else Duration(nanoseconds=nanoseconds)


@contextmanager
def _progress(duration: float) -> Iterator[Any]:
    """A function that shows seconds and a word; it does nothing where there is no terminal."""
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


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


if __name__ == "__main__":
    main()
