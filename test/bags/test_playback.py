"""Playback hands out messages when they are due."""

import threading
import time

import pytest

from contact_reach_ros.bags.reader import RawMessage
from contact_reach_ros.nodes.replay import paced

START = 1_700_000_000_000_000_000
MS = 1_000_000


def message(at_ms: float) -> RawMessage:
    return RawMessage("/a", START + int(at_ms * MS), 0, b"", 0)


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_no_message_comes_before_its_time(rate: float) -> None:
    messages = [message(at) for at in (0, 1, 1, 30, 5, 31, 60)]
    began_ns, taken = time.monotonic_ns(), []
    for raw in paced(messages, START, rate, threading.Event()):
        taken.append(raw)
        assert time.monotonic_ns() - began_ns >= (raw.log_time_ns - START) / rate
    assert taken == messages


def test_stop_ends_it_at_once() -> None:
    stopped = threading.Event()
    threading.Timer(0.1, stopped.set).start()
    assert list(paced([message(3_600_000)], START, 1.0, stopped)) == []
