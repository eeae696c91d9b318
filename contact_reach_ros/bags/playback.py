"""Hands out the messages of a recording at their times, by the steady clock."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from contact_reach_ros.bags.reader import RawMessage
from contact_reach_ros.timing import NANOSECONDS

_CLOSE_NS = 2_000_000
"""A message due within this time is waited for by sleeping exactly as long; a pause takes effect after it."""
_STALLED_NS = 500_000_000
"""A longer delay, as of a suspended process, is not made up for."""
_BLOCK = 256
_BLOCKS = 16
"""Number of blocks that are read ahead: a second at 4 kHz."""


class Playback:
    """A clock that runs through a recording, and can be paused and stopped from other threads.

    Every message has an absolute deadline on the steady clock, so that delays do not add up.

    Parameters
    ----------
    rate :
        Recorded time per real time, 1 for the original pace.
    paused :
        Whether to begin with a pause.

    Attributes
    ----------
    count :
        Number of messages handed out.
    """

    def __init__(self, rate: float = 1.0, paused: bool = False) -> None:
        self.count = 0
        self._rate = rate
        self._condition = threading.Condition()
        self._stopped, self._paused = False, paused
        self._paused_at_ns = 0
        # The time on the steady clock at which the recording's start was due.
        self._anchor_ns = 0

    def pause(self) -> None:
        """Stop the clock; messages that are due within 2 ms still follow."""
        with self._condition:
            if not self._paused:
                self._paused, self._paused_at_ns = True, time.monotonic_ns()
                self._condition.notify_all()

    def resume(self) -> None:
        """Continue from the current position."""
        with self._condition:
            if self._paused:
                self._paused = False
                self._anchor_ns += time.monotonic_ns() - self._paused_at_ns
                self._condition.notify_all()

    def stop(self) -> None:
        """Make `run` return at once."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def run(self, messages: Iterable[RawMessage], start_ns: int, publish: Callable[[RawMessage], None]) -> bool:
        """Hand out the messages; returns whether the end was reached.

        Parameters
        ----------
        messages :
            In the order of reception; one that follows a later one is handed out together with it.
        start_ns :
            Time of the recording to begin at, ns since the epoch.
        publish :
            Called with each message.
        """
        with self._condition:
            self._anchor_ns = self._paused_at_ns = time.monotonic_ns()
        for message in messages:
            if not self._wait_until(int((message.log_time_ns - start_ns) / self._rate)):
                return False
            publish(message)
            self.count += 1
        return not self._stopped

    def _wait_until(self, passed_ns: int) -> bool:
        """Wait until a real time since the start, ns, that pauses do not count towards; False after `stop`."""
        while not self._stopped:
            with self._condition:
                if self._paused:
                    self._condition.wait()
                    continue
                remaining_ns = self._anchor_ns + passed_ns - time.monotonic_ns()
                if remaining_ns > _CLOSE_NS:
                    self._condition.wait((remaining_ns - _CLOSE_NS / 2) / NANOSECONDS)
                    continue
                if remaining_ns < -_STALLED_NS:
                    self._anchor_ns -= remaining_ns
            if remaining_ns > 0:
                time.sleep(remaining_ns / NANOSECONDS)
            return True
        return False


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
