"""Replay: publishes the messages of a bag again under /replay, unchanged and at their recorded pace."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from pathlib import Path

from rclpy.duration import Duration
from rclpy.node import Node

from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import CDR, RecordedTopic
from contact_reach_ros.errors import ContactReachError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.discovery import CHOICES, environment
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.ros.parameters import without_ros_arguments
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.timing import NANOSECONDS

BAD_INPUT = 2

_RATES = (0.01, 100.0)
_MATCHED_S = 1.0
_ARRIVAL_S = 1.0
_LEAST_LOOP_S = 0.1
_STALLED_NS = 500_000_000
"""A longer delay, as of a process that was suspended with Ctrl-Z, is not made up for."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the options."""
    parser = argparse.ArgumentParser(prog=REPLAY, description="Publishes a bag's messages under /replay.")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a directory, or one mcap file")
    parser.add_argument("--rate", type=float, default=1.0, help="recorded time per time, 0.01 to 100 (default: 1)")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="skip the first seconds (default: 0)")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="publish these recorded topics only")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until interrupted")
    parser.add_argument("--discovery", default="host", choices=CHOICES, help="who hears it (default: host)")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay a bag, and exit with 0 at its end or when interrupted, or with 2 and a line that names what is wrong."""
    given = list(sys.argv if arguments is None else [REPLAY, *arguments])
    try:
        own = without_ros_arguments(given)
        options = make_parser().parse_args(own[1:])
        if not _RATES[0] <= options.rate <= _RATES[1]:
            raise InputError(f"--rate {options.rate:g}: expected {_RATES[0]:g} to {_RATES[1]:g}")
        reader = BagReader(options.bag)
        for note in reader.notes:
            print(f"{REPLAY}: {note}", file=sys.stderr)
        if not 0.0 <= options.start <= reader.duration:
            raise InputError(f"--start {options.start:g}: expected 0 to {reader.duration:.3f} s, which the bag has")
        left = reader.duration - options.start
        if options.loop and left < _LEAST_LOOP_S:
            raise InputError(f"--loop: {left:.3f} s are left to replay; expected at least {_LEAST_LOOP_S:g} s")
        chosen = choose_topics(reader, options.topics)
        stopped = threading.Event()
        os.environ.update(environment(options.discovery))
        # ROS ignores arguments that are not its own.
        with bare_node(REPLAY, given) as node:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: stopped.set())
            publish(node, reader, chosen, options, stopped)
    except ContactReachError as error:
        print(f"{REPLAY}: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)


def choose_topics(reader: BagReader, wanted: Sequence[str] | None) -> dict[str, type]:
    """Choose the topics to publish, with their message classes; prints on stderr which of them cannot be published.

    Raises `InputError` if a wanted topic is not in the bag, or none is left.

    Parameters
    ----------
    reader
        The bag.
    wanted
        Recorded names, with or without the leading slash; None for all topics.
    """
    known = reader.topics
    names = list(known) if wanted is None else [f"/{name.removeprefix('/')}" for name in wanted]
    chosen = {}
    for name in names:
        if name not in known:
            raise InputError(f"--topics {name}: the bag has no such topic; it has {', '.join(sorted(known))}")
        encoding, type_name = known[name].encoding, known[name].type
        kind = topics.message_class(type_name) if encoding == CDR else None
        if kind is not None:
            chosen[name] = kind
        else:
            what = f"{encoding or 'an unknown encoding'} of {type_name or 'an unknown type'}"
            print(f"{REPLAY}: {name} is left out: it has {what}, expected {CDR} of an installed type", file=sys.stderr)
    if not chosen:
        raise InputError(f"{reader.path}: there is no topic that can be published")
    return chosen


def publish(
    node: Node,
    reader: BagReader,
    chosen: Mapping[str, type],
    options: argparse.Namespace,
    stopped: threading.Event,
) -> None:
    """Publish a bag below /replay, where no arm listens.

    Raises `BagError` if the bag cannot be read.

    Parameters
    ----------
    node
        Publishes.
    reader
        The bag.
    chosen
        Topics to publish, with their message classes.
    options
        With `start`, s, `rate`, and `loop`: whether to begin again at the end.
    stopped
        Ends the replay; a signal handler may set it.
    """
    known_notes = reader.notes
    publishers = {
        name: node.create_publisher(kind, f"/{REPLAY}{name}", qos_profile(publisher_qos(reader.topics[name])))
        for name, kind in chosen.items()
    }
    # Subscriptions have to be matched before the first message.
    stopped.wait(_MATCHED_S)
    began, count, rounds = time.monotonic(), 0, 0
    start_ns = reader.start_ns + int(options.start * NANOSECONDS)
    for message in reader.raw_messages([name for name in chosen if reader.topics[name].latched]):
        # What latched topics still show then; publishers keep as many as they did.
        if message.log_time_ns >= start_ns:
            break
        publishers[message.topic].publish(message.data)
    while not stopped.is_set() and (options.loop or not rounds):
        for message in paced(reader.raw_messages(list(chosen), start_ns), start_ns, options.rate, stopped):
            publishers[message.topic].publish(message.data)
            count += 1
        rounds += 1
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=_ARRIVAL_S))
    seconds = time.monotonic() - began
    print(f"{REPLAY}: {count} messages of {len(publishers)} topics in {seconds:.1f} s, {rounds} times")
    for note in reader.notes:
        if note not in known_notes:
            print(f"{REPLAY}: {note}", file=sys.stderr)


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


def publisher_qos(topic: RecordedTopic) -> topics.Qos:
    """Return a reliable offer, which reaches everybody, latched as the topic was.

    The depth is that of the stack's topic, or one message for another latched topic and a deep queue for any other.
    """
    known = topics.find(topic.name)
    usual = known.qos if known is not None else topics.LATCHED if topic.latched else topics.STREAM
    return usual._replace(latched=topic.latched)


if __name__ == "__main__":
    main()
