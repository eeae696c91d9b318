"""Replay: publishes the messages of a bag again under /replay, unchanged and at their recorded pace."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import rclpy
from rclpy.node import Node

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import CDR
from contact_reach_ros.errors import BagError, ContactReachError, InputError
from contact_reach_ros.nodes.bag_publisher import BagPublisher
from contact_reach_ros.nodes.topic_recorder import message_class
from contact_reach_ros.ros.discovery import CHOICES
from contact_reach_ros.ros.interfaces import REPLAY
from contact_reach_ros.ros.parameters import without_ros_arguments
from contact_reach_ros.ros.process import initialise
from contact_reach_ros.timing import NANOSECONDS

BAD_INPUT = 2

_RATES = (0.01, 100.0)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the options of `run_replay`."""
    parser = argparse.ArgumentParser(prog=REPLAY, description="Publishes a bag's messages under /replay.")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a directory with metadata.yaml, or one mcap file")
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
    chosen = choose_topics(reader, options.topics)
    start_ns = reader.start_ns + int(options.start * NANOSECONDS)
    if not 0.0 <= options.start <= reader.duration:
        raise InputError(f"--start {options.start:g}: expected 0 to {reader.duration:.3f} s, which the bag has")
    initialise(arguments, options.discovery)
    node = Node(REPLAY)
    try:
        publisher = BagPublisher(node, reader, chosen, options.rate)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: publisher.stop())
        publisher.run(start_ns, options.loop)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


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
        try:
            if known[name].encoding != CDR:
                raise BagError(f"its messages are {known[name].encoding or 'of no known encoding'}, expected {CDR}")
            chosen[name] = message_class(known[name].type)
        except BagError as error:
            print(f"{REPLAY}: {name} is left out: {error}", file=sys.stderr)
    if not chosen:
        raise InputError(f"{reader.path}: there is no topic that can be published")
    return chosen


if __name__ == "__main__":
    main()
