"""Replay: publishes the messages of a bag again under /replay, unchanged and at their recorded pace."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path

from rclpy.duration import Duration
from rclpy.qos import QoSProfile

from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.bags.topics import CDR, OfferedQos
from contact_reach_ros.errors import BagError, ContactReachError, InputError
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.recorder import message_class
from contact_reach_ros.ros.discovery import CHOICES
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.ros.parameters import without_ros_arguments
from contact_reach_ros.ros.process import bare_node
from contact_reach_ros.timing import NANOSECONDS

BAD_INPUT = 2

_RATES = (0.01, 100.0)
_MATCHED_S = 1.0
_ARRIVAL_S = 1.0
_STALLED_NS = 500_000_000
"""A longer delay, as of a process that was suspended with Ctrl-Z, is not made up for."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the options of `run_replay`."""
    parser = argparse.ArgumentParser(prog=REPLAY, description="Publishes a bag's messages under /replay.")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a directory with metadata.yaml, or one mcap file")
    parser.add_argument("--rate", type=float, default=1.0, help="recorded time per time, 0.01 to 100 (default: 1)")
    parser.add_argument("--discovery", default="host", choices=CHOICES, help="who hears it (default: host)")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay a bag, and exit with 0 at its end or when interrupted, or with 2 and a line that names what is wrong."""
    given = list(sys.argv if arguments is None else [REPLAY, *arguments])
    try:
        own = without_ros_arguments(given)
        options = make_parser().parse_args(own[1:])
        # ROS ignores arguments that are not its own.
        run_replay(options, [REPLAY, *(given[1:] if len(own) < len(given) else [])])
    except ContactReachError as error:
        print(f"{REPLAY}: {error}", file=sys.stderr)
        sys.exit(BAD_INPUT)


def run_replay(options: argparse.Namespace, arguments: Sequence[str] = (REPLAY,)) -> None:
    """Replay a bag with these options until its end, Ctrl-C or SIGTERM.

    Raises `ContactReachError` if the options or the bag are refused.
    """
    if not _RATES[0] <= options.rate <= _RATES[1]:
        raise InputError(f"--rate {options.rate:g}: expected {_RATES[0]:g} to {_RATES[1]:g}")
    reader = BagReader(options.bag)
    for note in reader.notes:
        print(f"{REPLAY}: {note}", file=sys.stderr)
    known_notes, classes = reader.notes, _message_classes(reader)
    stopped = threading.Event()
    with bare_node(REPLAY, options.discovery, arguments) as node:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stopped.set())
        publishers = {
            name: node.create_publisher(kind, f"/{REPLAY}{name}", publisher_qos(name, reader.topics[name].offered_qos))
            for name, kind in classes.items()
        }
        # Subscriptions have to be matched before the first message.
        stopped.wait(_MATCHED_S)
        began, count = time.monotonic(), 0
        for message in paced(reader.raw_messages(list(classes)), reader.start_ns, options.rate, stopped):
            publishers[message.topic].publish(message.data)
            count += 1
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_ARRIVAL_S))
    print(f"{REPLAY}: {count} messages of {len(publishers)} topics in {time.monotonic() - began:.1f} s")
    for note in reader.notes:
        if note not in known_notes:
            print(f"{REPLAY}: {note}", file=sys.stderr)


def _message_classes(reader: BagReader) -> dict[str, type]:
    """The message class of each topic that can be published; prints on stderr which cannot.

    Raises `InputError` if none is left.
    """
    found = {}
    for name, topic in reader.topics.items():
        try:
            if topic.encoding != CDR:
                raise BagError(f"its messages are {topic.encoding or 'of no known encoding'}, expected {CDR}")
            found[name] = message_class(topic.type)
        except BagError as error:
            print(f"{REPLAY}: {name} is left out: {error}", file=sys.stderr)
    if not found:
        raise InputError(f"{reader.path}: there is no topic that can be published")
    return found


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
    """Return a quality of service that reaches everybody whom the recorded publishers reached.

    It is that of the stack's topic; any other topic is reliable, and latched where one of its publishers was.
    """
    known = topics.find(name)
    if known is not None:
        return qos_profile(known.qos)
    latched = any(profile.durability == "transient_local" for profile in offered)
    return qos_profile(topics.LATCHED if latched else topics.STREAM)


if __name__ == "__main__":
    main()
