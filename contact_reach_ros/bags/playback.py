"""Hands out the messages of a recording at their times, by the steady clock."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from contact_reach_ros.bags.reader import RawMessage
from contact_reach_ros.timing import NANOSECONDS

_STALLED_NS = 500_000_000
"""A longer delay, as of a process that was suspended with Ctrl-Z, is not made up for."""
_BLOCK = 256
_BLOCKS = 16
"""Number of blocks that are read ahead: a second at 4 kHz."""


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


def read_ahead(messages: Iterable[RawMessage]) -> Generator[RawMessage, None, None]:
    """Read messages in another thread, some time before they are requested."""
    remaining = iter(messages)
    reader = ThreadPoolExecutor(1, "reader")

    def read_block() -> list[RawMessage]:
        return list(islice(remaining, _BLOCK))

    try:
        blocks = deque(reader.submit(read_block) for _ in range(_BLOCKS))
        while block := blocks.popleft().result():
            blocks.append(reader.submit(read_block))
            yield from block
    finally:
        reader.shutdown(cancel_futures=True)
