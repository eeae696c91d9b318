"""Hands out the messages of a recording at their times, by the steady clock."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from contact_reach_ros.bags.reader import RawMessage
from contact_reach_ros.timing import NANOSECONDS, Histogram

_CLOSE_NS = 2_000_000
"""A message due within this time is waited for by sleeping exactly as long; a pause takes effect after it."""
_STALLED_NS = 500_000_000
_BLOCK = 256
_BLOCKS = 16
"""That are read ahead: a second at 4 kHz."""


class Playback:
    """A clock that runs through a recording, and can be paused, stepped and stopped from other threads.

    Every message has an absolute deadline on the steady clock, so that delays do not add up. Only after a delay of more
    than half a second, as of a suspended process, the deadlines of all later messages are shifted by it.

    Parameters
    ----------
    rate :
        Recorded time per real time, 1 for the original pace.
    ticks :
        Topics whose messages end a step.
    paused :
        Whether to begin with a pause.

    Attributes
    ----------
    late :
        Lateness of the messages, except those of steps and the first ones after a stall.
    count :
        Number of messages handed out.
    stalls :
        Number of delays of more than half a second.
    """

    def __init__(self, rate: float = 1.0, ticks: Collection[str] = (), paused: bool = False) -> None:
        self.late = Histogram()
        self.count = 0
        self.stalls = 0
        self._rate = rate
        self._ticks = frozenset(ticks)
        self._condition = threading.Condition()
        self._stopped = False
        self._paused = paused
        self._steps = 0
        # The recording's time `_position_ns` corresponds, or before a pause corresponded, to the steady `_anchor_ns`.
        self._anchor_ns: int | None = None
        self._position_ns = 0

    @property
    def paused(self) -> bool:
        """Whether the clock stands still."""
        return self._paused

    @property
    def position_ns(self) -> int:
        """Time of the recording, ns since the epoch; 0 before it runs. It continues after the last message."""
        with self._condition:
            return self._now()

    def pause(self) -> None:
        """Stop the clock; messages that are due within 2 ms still follow."""
        with self._condition:
            if not self._paused:
                self._position_ns = self._now()
                self._paused = True
                self._condition.notify_all()

    def resume(self) -> None:
        """Continue from the current position."""
        with self._condition:
            if self._paused:
                self._paused = False
                if self._anchor_ns is not None:
                    self._anchor_ns = time.monotonic_ns()
                self._condition.notify_all()

    def step(self) -> bool:
        """Hand out all messages up to the next tick; without a pause return False and do nothing."""
        with self._condition:
            if self._paused:
                self._steps += 1
                self._condition.notify_all()
            return self._paused

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
            self._anchor_ns, self._position_ns = time.monotonic_ns(), start_ns
        for message in messages:
            due_ns = self._wait_for(message)
            if self._stopped:
                return False
            if due_ns is not None:
                late_ns = time.monotonic_ns() - due_ns
                if late_ns > _STALLED_NS:
                    self._shift(late_ns)
                else:
                    self.late.add(late_ns)
            publish(message)
            self.count += 1
        return not self._stopped

    def _wait_for(self, message: RawMessage) -> int | None:
        """Wait until a message is due, or `stop`; returns when it was due, or None for one of a step."""
        while not self._stopped:
            with self._condition:
                if self._paused:
                    if self._steps:
                        self._steps -= message.topic in self._ticks
                        self._position_ns = max(self._position_ns, message.log_time_ns)
                        return None
                    self._condition.wait()
                    continue
                due_ns = (self._anchor_ns or 0) + int((message.log_time_ns - self._position_ns) / self._rate)
                remaining_ns = due_ns - time.monotonic_ns()
                if remaining_ns > _CLOSE_NS:
                    self._condition.wait((remaining_ns - _CLOSE_NS / 2) / NANOSECONDS)
                    continue
            if remaining_ns > 0:
                time.sleep(remaining_ns / NANOSECONDS)
            return due_ns
        return None

    def _shift(self, delay_ns: int) -> None:
        with self._condition:
            self._anchor_ns = (self._anchor_ns or 0) + delay_ns
            self.stalls += 1

    def _now(self) -> int:
        if self._paused or self._anchor_ns is None:
            return self._position_ns
        return self._position_ns + int((time.monotonic_ns() - self._anchor_ns) * self._rate)


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
