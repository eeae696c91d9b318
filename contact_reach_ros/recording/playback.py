"""Handing out the messages of a recording at their time, against the steady clock."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Collection, Generator, Iterable

from contact_reach_ros.recording.bag_reader import RawMessage
from contact_reach_ros.timing import Histogram
from contact_reach_ros.units import NANOSECONDS

_CLOSE_NS = 2_000_000
"""Nearer than this a message is waited for by sleeping to its very time, and a pause comes after it."""
_STALLED_NS = 500_000_000
_BLOCK = 256
_BLOCKS = 16
"""Read ahead: a second of 4 kHz."""


class Playback:
    """A clock that runs through a recording, and can be paused, stepped and stopped from other threads.

    Every message has an absolute deadline on the steady clock, so that delays do not add up. Only a delay of more than
    half a second, as of a process that was suspended, is taken over by all that follow, which keep their distances.

    Parameters
    ----------
    rate :
        Recorded time per time, 1 for the original pace.
    ticks :
        Topics of the messages at which a step ends.
    paused :
        Whether to begin with a pause.

    Attributes
    ----------
    late :
        By how much the messages were late when they were handed out, those of steps and the first ones after a delay
        aside.
    count :
        Messages handed out.
    stalls :
        Delays of more than half a second.
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
        # The recording's time `_position_ns` is, or with a pause was, the steady clock's `_anchor_ns`.
        self._anchor_ns: int | None = None
        self._position_ns = 0

    @property
    def paused(self) -> bool:
        """Whether the clock stands still."""
        return self._paused

    @property
    def position_ns(self) -> int:
        """Time of the recording, ns since the epoch; 0 before it runs. Behind the last message it goes on."""
        with self._condition:
            return self._now()

    def pause(self) -> None:
        """Stand still; the messages that are due within 2 ms still come."""
        with self._condition:
            if not self._paused:
                self._position_ns = self._now()
                self._paused = True
                self._condition.notify_all()

    def resume(self) -> None:
        """Go on from where it stands."""
        with self._condition:
            if self._paused:
                self._paused = False
                if self._anchor_ns is not None:
                    self._anchor_ns = time.monotonic_ns()
                self._condition.notify_all()

    def step(self) -> bool:
        """Hand out all messages up to the next tick; False, and nothing, if there is no pause."""
        with self._condition:
            if self._paused:
                self._steps += 1
                self._condition.notify_all()
            return self._paused

    def stop(self) -> None:
        """Let `run` return at once."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def run(self, messages: Iterable[RawMessage], start_ns: int, publish: Callable[[RawMessage], None]) -> bool:
        """Hand out the messages; returns whether it got to the end.

        Parameters
        ----------
        messages :
            In the order of their times of reception; one that comes behind a later one is handed out with it.
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
                    self._take_over(late_ns)
                else:
                    self.late.add(late_ns)
            publish(message)
            self.count += 1
        return not self._stopped

    def _wait_for(self, message: RawMessage) -> int | None:
        """Until a message is due, or stopped; returns when it was due, or None for one of a step."""
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

    def _take_over(self, delay_ns: int) -> None:
        with self._condition:
            self._anchor_ns = (self._anchor_ns or 0) + delay_ns
            self.stalls += 1

    def _now(self) -> int:
        if self._paused or self._anchor_ns is None:
            return self._position_ns
        return self._position_ns + int((time.monotonic_ns() - self._anchor_ns) * self._rate)


def read_ahead(
    messages: Iterable[RawMessage], prepare: Callable[[], None] = lambda: None
) -> Generator[RawMessage, None, None]:
    """The same messages, read by another thread some time before they are asked for.

    Parameters
    ----------
    messages :
        To be read.
    prepare :
        Called in that thread when it starts.
    """
    blocks: queue.Queue[list[RawMessage] | BaseException | None] = queue.Queue(_BLOCKS)
    abandoned = threading.Event()

    def put(item: list[RawMessage] | BaseException | None) -> bool:
        while not abandoned.is_set():
            try:
                blocks.put(item, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def read() -> None:
        block: list[RawMessage] = []
        try:
            prepare()
            for message in messages:
                block.append(message)
                if len(block) == _BLOCK:
                    if not put(block):
                        return
                    block = []
            put(block)
            put(None)
        except BaseException as error:  # raised again where the messages are asked for
            put(error)

    reader = threading.Thread(target=read, name="reader", daemon=True)
    reader.start()
    try:
        while (item := blocks.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield from item
    finally:
        abandoned.set()
        reader.join()
